"""Event-sent hand states beside one in every tick: messages once settled, exactness and safety, on good and
bad links; and what a tick costs. In virtual time.

The same starts and the same links, driven twice. *Settled* counts the last ten seconds.
"""

from __future__ import annotations

from statistics import median
from typing import Final

from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages import key_expressions
from agent.messages.codec import decode
from deploy.console.arguments import fleet_path
from deploy.recording.collector import RunData
from deploy.simulate.simulation import Simulation
from deploy.verdict.run_result import RunResult
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.tick import probe

FLEETS: Final = (("delta", 30.0), ("obstacles", 80.0), ("lattice45", 30.0))
LINKS: Final = (
    ("clean", ()),
    ("100 ms +- 20, 20 %", ("faults.delay=100ms 20ms", "faults.loss=20%")),
    ("200 ms, 30 %", ("faults.delay=200ms", "faults.loss=30%")),
)
EVENT: Final = 'control.send="event"'
SETTLED_S: Final = 10.0
SETTLED_MAX: Final = 0.1
RMS_MAX: Final = 1.1


def fleet(name: str, *overrides: str) -> Fleet:
    return resolved(load_fleet(fleet_path(name), overrides))


def drive(made: Fleet) -> tuple[float, float, float, float, bool]:
    """(hand states a period and robot when settled, over all; RMS distance error, m; least distance, m;
    passed)."""
    data = RunData(made, mode="simulate")
    hands = {key_expressions.hand(made.fleet.name, robot) for robot in made.ids}
    came_ns: list[int] = []

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        if key in hands:
            came_ns.append(received_ns)
        else:
            data.feed(received_ns, key, decode(payload))

    simulation = Simulation(made, sink)
    simulation.run(lambda _: True)
    recording = data.recording(reasons=simulation.reasons)
    found = RunResult(recording)
    end_ns = (recording.epoch_ns or 0) + round(made.fleet.duration_s * 1e9)
    rate = made.fleet.rate_hz * len(made.ids)
    settled = sum(end_ns - SETTLED_S * 1e9 < each <= end_ns for each in came_ns) / (SETTLED_S * rate)
    over_all = len(came_ns) / (made.fleet.duration_s * rate)
    metrics = found.metrics
    return (
        settled,
        over_all,
        metrics["rms_distance_error_m"],
        metrics["min_distance_m"]["any"],
        found.passed,
    )


def run(options: Options) -> Result:
    result, rows = Result([]), []
    seeds = range(1 if options.quick else options.count or 5)
    for name, duration_s in FLEETS[:1] if options.quick else FLEETS:
        for links, faults in LINKS:
            pairs = []
            for seed in seeds:
                common = (f"fleet.duration_s={duration_s}", f"fleet.seed={seed}", *faults)
                pairs.append((drive(fleet(name, *common)), drive(fleet(name, *common, EVENT))))
            settled = max(event[0] for _, event in pairs)
            ratio = median(event[2] / periodic[2] for periodic, event in pairs)
            least = min(event[3] for _, event in pairs)
            usual = min(periodic[3] for periodic, _ in pairs)
            what = f"{name}, {links}"
            result.figures += [
                Figure(f"{what}: hand states settled, event / periodic", settled, "", SETTLED_MAX),
                Figure(f"{what}: RMS distance error, event / periodic", ratio, "", RMS_MAX),
                Figure(f"{what}: closest pair", least, "m", 0.95 * usual, at_most=False),
            ]
            over_all = median(event[1] for _, event in pairs)
            passed = sum(event[4] for _, event in pairs), sum(periodic[4] for periodic, _ in pairs)
            rows.append(
                [
                    what,
                    f"{settled:.3f}",
                    f"{over_all:.3f}",
                    f"{ratio:.3f}",
                    f"{least:.3f}",
                    f"{usual:.3f}",
                    f"{passed[0]} / {passed[1]}",
                ]
            )
    ticks = {
        sends: median(probe(20.0, fleet=fleet("delta", f'control.send="{sends}"')).ticks_us)
        for sends in ("periodic", "event")
    }
    result.figures.append(Figure("tick of the delta, event / periodic", ticks["event"] / ticks["periodic"]))
    result.details += table(
        ["", "settled", "over all", "RMS ratio", "closest, m", "periodic", "passed, periodic"], rows
    )
    result.details.append(", ".join(f"tick {sends} {us:.1f} us" for sends, us in ticks.items()))
    return result
