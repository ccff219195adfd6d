"""Does a law of others work where the fleet starts, how long does it take, and what cannot be said of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from statistics import median
from typing import Final

from handfast.agent.control import own_law
from handfast.agent.control.law import navigation_force
from handfast.agent.control.own_law import LawError, Moment, Neighbour, Reference
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, start_hands
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.analysis import patience
from handfast.deploy.analysis.couplings import own_law_of
from handfast.deploy.check.finding import Finding

ROUNDS: Final = 3
"""So many times every robot's law is asked: the first time it warms up, and has no numbers of the others."""
TIMED_S: Final = 2.0
"""It is not asked any more after so long."""


def check_own_law(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Makes a fleet's law of others and asks it at the start; what cannot be predicted of it."""
    name = fleet.control.law
    if name is None:
        return
    try:
        took_s = patience.answer("it", lambda: _took_s(fleet, geometry))
        modes = own_law_of(fleet)
    except LawError as error:
        yield Finding("error", "control.law", str(error))
        return
    except TimeoutError as error:
        yield Finding("error", "control.law", f"law {name}: {error}, where the fleet starts")
        return
    given, right = 0 if modes is None else len(modes.modes(geometry)), 2 * len(fleet.members)
    if modes is not None and given != right:
        got = given if given < right else "more"
        wrong = f"modes() must give two modes for each robot that has a place, {right}, got {got}"
        yield Finding("error", "control.law", f"law {name}: {wrong}")
        return
    period_s = 1.0 / fleet.fleet.rate_hz
    if took_s > patience.SHARE_MAX * period_s:
        yield Finding(
            "warning",
            "control.law",
            f"law {name} takes {1e3 * took_s:.3g} ms here, {took_s / period_s:.0%} of a period: robots "
            "whose law is too slow skip ticks; make it faster, or lower fleet.rate_hz",
        )
    unknown = "where accelerations are clipped and how near edges come"
    if modes is None:
        unknown = "whether it is stable, when it settles, " + unknown
    yield Finding("info", "control.law", f"law {name} cannot be predicted ({unknown}): simulate it")


def _took_s(fleet: Fleet, geometry: Geometry) -> float:
    """How long one robot's law takes at the start, s; raises `LawError` where it fails there."""
    laws = {robot: own_law.make(fleet, robot) for robot in fleet.ids}
    hands = start_hands(fleet).tolist()
    x, y, vx, vy, ax, ay = make_trajectory(fleet.trajectory).at(0.0)
    c1, c2 = fleet.control.c1, fleet.control.c2
    moments: dict[int, Moment] = {}
    for k, (robot, (hx, hy)) in enumerate(zip(geometry.ids, hands, strict=True)):
        px, py = x + float(geometry.offsets[k, 0]), y + float(geometry.offsets[k, 1])
        force = navigation_force(ax, hx - px, -vx, c1, c2), navigation_force(ay, hy - py, -vy, c1, c2)
        reference = Reference((px, py), (vx, vy), (ax, ay))
        moments[robot] = Moment(0.0, 1.0 / fleet.fleet.rate_hz, (hx, hy), (0.0, 0.0), force, reference, ())
    numbers: dict[int, tuple[float, ...]] = {}
    for robot in moments:
        own_law.restart(laws[robot])
    times, until = [0.0], time.perf_counter() + TIMED_S
    for _ in range(ROUNDS):
        for robot, moment in moments.items():
            near = []
            for (i, j), distance in zip(geometry.edges.tolist(), geometry.distances.tolist(), strict=True):
                a, b = geometry.ids[i], geometry.ids[j]
                if robot in (a, b):
                    other = b if robot == a else a
                    there, own = moments[other], numbers.get(other, ())
                    near.append(
                        Neighbour(
                            other, there.position, (0.0, 0.0), there.navigation, distance, 0.0, 1.0, 0.0, own
                        )
                    )
            begun = time.perf_counter()
            _, numbers[robot] = own_law.evaluate(laws[robot], moment._replace(neighbours=tuple(near)))
            times.append(time.perf_counter() - begun)
            if time.perf_counter() > until:
                return max(times[1:])
    return median(times)
