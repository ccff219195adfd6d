"""Whether all robots of a fleet come to their places and stay there, when, and how near each other they came.

Our own, as they are simulated, and as a yardstick ORCA (van den Berg, Guy, Lin and Manocha, "Reciprocal
n-body collision avoidance", 2011) on the same starts: points that may move in any direction at any
acceleration and know where all others are, in discs of half the safe distance. It needs `pip install pyrvo`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from math import cos, hypot, inf, pi, sin
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.limits import clearance
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, start_hand
from handfast.agent.formation.trajectory import make_trajectory
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import PlantState
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.simulate.worker_pool import Abandoned, GoOn
from tests.benchmarks.figures import number

Points = NDArray[np.float64]

THERE_M: Final = 0.1
"""Who is nearer to its place has arrived."""
STAYS_S: Final = 1.0
STEP_S: Final = 0.02
"""Of ORCA: at 0.05 s its discs overlap by up to a third in the middle of a swap of 45."""
HORIZON_S: Final = 2.0
"""For so long ahead ORCA rules out collisions."""
SLOWS_S: Final = 0.5
"""ORCA's robots want to be at their places in so long, within their speed limit."""
NUDGE: Final = 1e-3
"""m/s: what breaks symmetries, as the examples of ORCA's library do."""
CORNERS: Final = 16
"""Of a circle, for ORCA."""


class Went(NamedTuple):
    """How a run went: seconds until all had arrived to stay, None if they had not; the closest pair, m."""

    seconds: float | None
    pair_m: float


class _Judge:
    """Looks at hands at one instant after the other."""

    def __init__(self, fleet: Fleet) -> None:
        geometry = resolve(fleet)
        self._offsets = geometry.offsets
        self._trajectory = make_trajectory(fleet.trajectory)
        self._since_s: float | None = None
        self._pairs = np.triu_indices(len(geometry.ids), 1)
        self.pair_m = inf

    def places(self, t: float) -> Points:
        """Places of all at the fleet time `t`, (n, 2) m."""
        x, y, *_ = self._trajectory.at(t)
        return np.add(self._offsets, (x, y))

    def velocity(self, t: float) -> tuple[float, float]:
        """Of all places, m/s."""
        _, _, vx, vy, *_ = self._trajectory.at(t)
        return vx, vy

    def look(self, t: float, hands: Points) -> None:
        i, j = self._pairs
        self.pair_m = min(self.pair_m, float(np.hypot(*(hands[i] - hands[j]).T).min()))
        there = bool((np.hypot(*(hands - self.places(t)).T) < THERE_M).all())
        self._since_s = (t if self._since_s is None else self._since_s) if there else None

    def arrived(self, t: float) -> bool:
        return self._since_s is not None and t - self._since_s >= STAYS_S

    def went(self, t: float) -> Went:
        return Went(self._since_s if self.arrived(t) else None, self.pair_m)


def drive(fleet: Fleet, go_on: GoOn = lambda: True) -> Went:
    """Simulates `fleet` (resolved) until all have arrived, for its duration at most.

    Raises:
        Abandoned: `go_on` said no.
    """
    judge, ids = _Judge(fleet), list(fleet.ids)
    keys = {key_expressions.plant_truth(fleet.fleet.name, robot): k for k, robot in enumerate(ids)}
    keys |= {key_expressions.plant_state(fleet.fleet.name, robot): k for k, robot in enumerate(ids)}
    reach = [fleet.robot(robot).hand_offset_m for robot in ids]
    hands = np.array([start_hand(fleet.robot(robot)) for robot in ids])
    last_ns = 0
    seen_s = 0.0

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        nonlocal last_ns, seen_s
        k = keys.get(key)
        if k is None:
            return
        state = decode(payload)
        assert isinstance(state, PlantState)
        if state.time_ns > last_ns and k == 0:
            last_ns = state.time_ns
            seen_s = (last_ns - simulation.epoch_ns) / NS_PER_S
            if seen_s > 0.0:
                judge.look(seen_s, hands)
        hands[k] = state.x + reach[k] * cos(state.heading), state.y + reach[k] * sin(state.heading)

    def progress(_: float) -> bool:
        if not go_on():
            raise Abandoned
        return not judge.arrived(seen_s)

    simulation = Simulation(fleet, sink)
    simulation.run(progress)
    return judge.went(seen_s)


def orca(fleet: Fleet, go_on: GoOn = lambda: True) -> Went:
    """Drives ORCA's points from the starts of `fleet` (resolved) to its places, among its obstacles."""
    radius, most = 0.5 * fleet.formation.safe_distance_m, fleet.control.max_speed_mps
    rvo: Any = import_module("pyrvo")
    world = rvo.RVOSimulator(
        STEP_S, 2.0 * most * HORIZON_S, len(fleet.ids), HORIZON_S, 0.5 * HORIZON_S, radius, most
    )
    grown = clearance(fleet.avoidance.clearance_m, fleet.formation.safe_distance_m) - radius
    for each in fleet.obstacles:
        if each.centre_m is not None and each.radius_m is not None:
            (x, y), r = each.centre_m, (each.radius_m + grown) / cos(pi / CORNERS)
            turns = [2.0 * pi * k / CORNERS for k in range(CORNERS)]
            world.add_obstacle([(x + r * cos(turn), y + r * sin(turn)) for turn in turns])
        else:
            world.add_obstacle([tuple(point) for point in each.points_m or ()])
    world.process_obstacles()
    judge, nudge = _Judge(fleet), np.random.default_rng(fleet.fleet.seed)
    agents = [world.add_agent(start_hand(fleet.robot(robot))) for robot in fleet.ids]
    t = 0.0
    while t < fleet.fleet.duration_s and not judge.arrived(t):
        if not go_on():
            raise Abandoned
        at = [world.get_agent_position(agent) for agent in agents]
        hands = np.array([(point.x, point.y) for point in at])
        judge.look(t, hands)
        places, (vx, vy) = judge.places(t), judge.velocity(t)
        for agent, (ex, ey) in zip(agents, (places - hands).tolist(), strict=True):
            x, y = vx + ex / SLOWS_S, vy + ey / SLOWS_S
            share = min(1.0, most / max(hypot(x, y), 1e-9))
            angle = nudge.uniform(0.0, 2.0 * pi)
            world.set_agent_pref_velocity(
                agent, (share * x + NUDGE * cos(angle), share * y + NUDGE * sin(angle))
            )
        world.do_step()
        t += STEP_S
    return judge.went(t)


def has_orca() -> bool:
    try:
        import_module("pyrvo")
    except ImportError:
        return False
    return True


@dataclass(frozen=True)
class Runs:
    """Many of them, as work for a pool: `fleet` makes the fleet of a run, `driven` drives it."""

    fleet: Callable[[int], Fleet]
    driven: Callable[[Fleet, GoOn], Went]

    def execute(self, run: int, go_on: GoOn) -> Went:
        return self.driven(self.fleet(run), go_on)

    def unfinished(self, run: int, reason: str, wall_s: float, *, timed_out: bool) -> Went:
        return Went(None, inf)


HEADING: Final = ("arrived", "closest pair m", "median s", "slowest s")
"""Of what `line` gives after the name."""


def line(name: str, found: list[Went]) -> list[str]:
    took = [each.seconds for each in found if each.seconds is not None]
    times = [number(float(np.median(took))), number(max(took))] if took else ["-", "-"]
    return [name, f"{len(took)} of {len(found)}", f"{min(each.pair_m for each in found):.3f}", *times]
