"""Does a plant of others work where its robots start, how long does it take, what cannot be said of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Final

from handfast.agent.common.plugins import PluginError
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet import plants
from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis import patience
from handfast.deploy.check.finding import Finding, Level
from handfast.plant.backend import Begin, Command
from handfast.plant.plugin import begin_virtual

STEPS: Final = 5
TIMED_S: Final = 5.0
"""No further robot of a plant is asked after so long."""
BEGIN_NS: Final = 1_000 * NS_PER_S
"""As with the clock of a wall, nothing that it can see is from before 0."""


def check_own_plants(fleet: Fleet) -> Iterator[Finding]:
    """Makes what stands for each plant of others in virtual time, and asks it at the start."""
    places: dict[str, dict[int, str]] = {}
    for number, robot in enumerate(fleet.robots, 1):
        if robot.kind.is_plugin:
            places.setdefault(robot.plant, {})[robot.id] = f"robot[{number}].plant"
    for name, where in places.items():
        plugin = plants.load(name)
        if plugin.vehicle and plugin.simulated is None:
            continue  # it is not for us to touch
        said: set[str] = set()
        for asked, level, text in _answers(fleet, name, tuple(where)):
            key = name if level == "warning" else text  # each robot's takes another time
            if key not in said:
                said.add(key)
                yield Finding(level, where[asked], text)


def _answers(fleet: Fleet, name: str, robots: Sequence[int]) -> list[tuple[int, Level, str]]:
    """What is to be said of each robot of a plant; they are asked together, as they are made for a drive."""

    def asked() -> list[tuple[int, Level, str]]:
        found: list[tuple[int, Level, str]] = []
        until = time.monotonic() + TIMED_S
        for robot in robots:
            found += [(robot, level, text) for level, text in _looked_at(fleet, robot)]
            if time.monotonic() > until:
                break
        return found

    try:
        return patience.answer("it", asked)
    except TimeoutError as error:
        return [(robots[0], "error", f"plant {name}: {error}, where its robot starts")]


def _looked_at(fleet: Fleet, robot: int) -> Iterator[tuple[Level, str]]:
    try:
        body = begin_virtual(fleet, robot, Begin(BEGIN_NS))
    except PluginError as error:
        yield "error", str(error)
        return
    times = []
    for step in range(STEPS):
        begun = time.perf_counter()
        body.step(BEGIN_NS + step * fleet.period_ns, Command(0.0, 0.0) if step else None)
        times.append(time.perf_counter() - begun)
    body.clear_to_drive()
    body.checks(BEGIN_NS)
    body.close()
    name = f"plant {fleet.robot(robot).plant}"
    took_s, period_s = median(times), 1.0 / fleet.fleet.rate_hz
    if body.failed:
        yield "error", body.failed
    elif took_s > patience.SHARE_MAX * period_s:
        share = f"{1e3 * took_s:.3g} ms here, {took_s / period_s:.0%} of a period"
        yield (
            "warning",
            f"{name}: a step takes {share}: a plant that is too slow skips ticks; make it faster, or lower "
            "fleet.rate_hz",
        )
    yield "info", f"{name} cannot be predicted (how it brakes and turns): simulate it"
