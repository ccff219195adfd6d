"""Short runs in virtual time, for tests of what is made of recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import tomli_w

from handfast.agent.fleet.loading import parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Faults, Message
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.recording import Recording
from handfast.deploy.simulate.simulation import Simulation

Sent = tuple[int, str, Message]

TRIO = """
[fleet]
name = "trio"
duration_s = {duration}
[formation]
offsets = [[0.0, 0.0], [1.0, 0.0], [0.5, 0.9]]
edges = [[1, 2], [2, 3], [1, 3]]
safe_distance_m = 0.22
[trajectory]
kind = "line"
velocity_mps = [0.1, 0.0]
[[robot]]
id = 1
x_m = 0.0
y_m = 0.1
[[robot]]
id = 2
x_m = 1.1
y_m = 0.0
[[robot]]
id = 3
x_m = 0.5
y_m = 1.0
"""


def trio(faults: str = "", duration: float = 2.0) -> Fleet:
    """Three robots in a triangle with these faults (TOML)."""
    return resolved(parse_fleet(TRIO.format(duration=duration) + faults, source="trio.toml"))


def driven(fleet: Fleet, live: Callable[[int], Iterable[tuple[float, Faults]]] = lambda _: ()) -> list[Sent]:
    """Every message of the whole run, as it came.

    live: from the wall time of the epoch (ns), live rules and the fleet time (s, in quarters) to send them.
    """
    sent: list[Sent] = []

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        sent.append((time_ns, key, decode(payload)))

    simulation = Simulation(fleet, sink)
    waiting: list[tuple[float, Faults]] | None = None

    def progress(time_s: float) -> bool:
        nonlocal waiting
        waiting = list(live(simulation.epoch_ns)) if waiting is None else waiting
        for at, message in [each for each in waiting if each[0] <= time_s]:
            waiting.remove((at, message))
            simulation.publish(key_expressions.faults(fleet.fleet.name), encode(message))
        return True

    simulation.run(progress)
    assert not simulation.reasons
    return sent


def recorded(fleet: Fleet, sent: Iterable[Sent]) -> Recording:
    data = RunData(fleet, mode="simulate")
    for each in sent:
        data.feed(*each)
    return data.recording()


def leave_run(folder: Path, fleet: Fleet, sent: Iterable[Sent]) -> Path:
    """The folder that such a run leaves, before its report."""
    folder.mkdir(exist_ok=True)
    toml = tomli_w.dumps(to_dict(fleet))
    (folder / "fleet.toml").write_text(toml)
    with Recorder(folder / "run.mcap", fleet, mode="simulate", fleet_toml=toml) as recorder:
        for received_ns, key, message in sent:
            recorder.record(received_ns, key, encode(message))
    return folder
