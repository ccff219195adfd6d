"""What the robots' radios carry, and whether it fits into `network.budget` (PURE).

Bytes on the link, as `agent.links.wire_size` counts them. All stand at their places, nobody is silent, no
fault rule holds, and no order has just been given: that is what goes on all the time. Robots that pass each
other on the way to their places listen to each other as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from agent.control.safety_distances import sensing_distance
from agent.fleet.model import Fleet
from agent.formation.geometry import Geometry
from agent.links.wire_size import (
    KEEP_ALIVE_HZ,
    acknowledged_bytes,
    carried_bytes,
    joined_bytes,
    keep_alive_bytes,
)
from agent.messages.codec import encode
from agent.messages.sequence_numbers import FIRST_ROUND
from agent.messages.types import (
    HEARD_ROUNDS,
    Beacon,
    HandState,
    Message,
    NeighbourStatus,
    PlantState,
    Status,
    Total,
    Wrench,
)
from deploy.check.finding import Finding
from deploy.check.loop import check_loop
from deploy.check.network import STATUS_HZ, beacon_hz
from deploy.check.safety import parting

_NOW_NS: Final = 1_790_000_000_000_000_000
_ROUND: Final = FIRST_ROUND + 10_000
_ECHO_US: Final = 20_000
_GOOD_HZ: Final = 10.0
"""A lower rate than this is not proposed while beacons can be fewer."""
_BEACON_HZ: Final = (2.0, 1.0, 0.5)
"""Fewer beacons that are proposed."""
_PERIODS: Final = 2.5
"""Timeouts of plant and wrench at a rate at which they would be shorter than the least that is allowed."""
_COUNTERS: Final = (
    "sent", "received", "lost", "delayed", "duplicated", "corrupted", "rejected", "overruns",
    "filtered.any", "filtered.speed",
)  # fmt: skip
"""What a status counts in an uneventful drive."""


class Stream(NamedTuple):
    """Messages of one kind that leave, or come to, a robot.

    Attributes:
        hz: how often.
        copies: over so many links, each time.
        bytes: of one without what is around it, on average.
        joined: of the copies, so many go along with another message of their tick.
    """

    hz: float
    copies: int
    bytes: float
    joined: int = 0


class RadioLoad(NamedTuple):
    """What the radio of a robot sends and receives, bit/s."""

    robot: int
    up: float
    down: float

    @property
    def most(self) -> float:
        """The way that carries more."""
        return max(self.up, self.down)

    def __str__(self) -> str:
        return f"robot {self.robot} sends {kbit(self.up)} and receives {kbit(self.down)}"


def kbit(bits_per_second: float) -> str:
    """In kbit/s, or in Mbit/s from 1000 of these on, in three digits."""
    if bits_per_second < 999_500.0:
        return f"{bits_per_second / 1e3:.3g} kbit/s"
    return f"{bits_per_second / 1e6:.4g} Mbit/s"


def radio_loads(fleet: Fleet, geometry: Geometry, *, operator: bool) -> list[RadioLoad]:
    """Of every robot, in the order of the file.

    Args:
        operator: whether one listens to all, as `handfast drive` does to record it.
    """
    listened = listeners(fleet, geometry)
    hands = {robot: _hand_bytes(fleet, robot, listened[robot]) for robot in fleet.ids}
    return [_load(fleet, robot, listened[robot], hands, operator) for robot in fleet.ids]


def worst_load(fleet: Fleet, geometry: Geometry, *, operator: bool) -> RadioLoad:
    """Of the robot whose radio carries most."""
    return max(radio_loads(fleet, geometry, operator=operator), key=lambda load: load.most)


def listeners(fleet: Fleet, geometry: Geometry) -> dict[int, set[int]]:
    """Whose hand states each robot listens to when all are at their places; these listen to its own."""
    found: dict[int, set[int]] = {robot: set() for robot in fleet.ids}
    ids = geometry.ids
    for i, j in geometry.edges.tolist():
        found[ids[i]].add(ids[j])
        found[ids[j]].add(ids[i])
    if not fleet.avoidance.enabled:
        return found
    x, y = geometry.offsets.T
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    near = np.argwhere(apart < sensing_distance(fleet, parting(fleet, geometry)[0]))
    for i, j in near.tolist():
        if i != j:
            found[ids[i]].add(ids[j])
    return found


def _load(
    fleet: Fleet, robot: int, near: Set[int], hand_bytes: Mapping[int, float], operator: bool
) -> RadioLoad:
    """Of one robot that listens to those in `near`; sizes of all robots' hand states by their ids."""
    up, down = _streams(fleet, robot, near, hand_bytes, operator)
    secured = fleet.is_secured
    links, idle = _idle(fleet, near)
    signs = keep_alive_bytes(secured) + acknowledged_bytes(0.0, secured)
    sent = received = links * idle * signs
    for streams, there, back in ((up, 1, 0), (down, 0, 1)):
        for hz, copies, size, joined in streams:
            alone = copies - joined
            carried = hz * (alone * carried_bytes(size, secured) + joined * joined_bytes(size))
            acknowledged = hz * alone * acknowledged_bytes(size, secured)
            sent += there * carried + back * acknowledged
            received += back * carried + there * acknowledged
    return RadioLoad(robot, 8.0 * sent, 8.0 * received)


def _idle(fleet: Fleet, near: Set[int]) -> tuple[int, float]:
    """Links on which less goes than signs of life would, each way, and how often one of these goes then."""
    others = len(fleet.robots) - 1
    if fleet.is_routed or not others:
        return 0, 0.0
    return others - len(near), max(0.0, KEEP_ALIVE_HZ - beacon_hz(fleet))


def _streams(
    fleet: Fleet, robot: int, near: Set[int], hand_bytes: Mapping[int, float], operator: bool
) -> tuple[list[Stream], list[Stream]]:
    """What leaves a robot, and what comes to it."""
    rate, beacons = fleet.fleet.rate_hz, beacon_hz(fleet)
    others = len(fleet.robots) - 1
    # Of what is said on links to routers they make a copy for each; in a mesh its sender does.
    hands, beacons_to = len(near) + operator, others + operator
    if fleet.is_routed:
        hands, beacons_to = min(1, hands), min(1, beacons_to)
    up = [
        Stream(rate, hands, hand_bytes[robot]),
        Stream(beacons, beacons_to, _beacon_bytes(robot), hands),
    ]
    if operator:
        up += [
            Stream(rate, 1, _size(_wrench(robot)), 1),
            Stream(STATUS_HZ, 1, _size(_status(fleet, robot)), 1),
            Stream(rate, 1, _size(_plant_state(robot))),  # from another process
        ]
        if _tells_truth(fleet, robot):
            up.append(Stream(rate, 1, _size(_plant_state(robot)), 1))
    down = [Stream(rate, 1, hand_bytes[other]) for other in sorted(near)]
    down.append(Stream(beacons, others, _beacon_bytes(robot), len(near)))
    return up, down


# --- what is said of it ------------------------------------------------------------------------


def describe_radio(fleet: Fleet, geometry: Geometry) -> Iterator[str]:
    """What the busiest radio carries, in a line; nothing without a budget."""
    if fleet.network.budget is None:
        return
    alone = worst_load(fleet, geometry, operator=False)
    watched = worst_load(fleet, geometry, operator=True)
    yield (
        f"radio: {alone}, of {kbit(fleet.network.budget)} each way; while an operator listens to all, "
        f"{watched}" + ("; emulated" if fleet.network.emulate_budget else "")
    )


def check_radio(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Warns of messages that the budget does not carry, and says which rates fit."""
    budget = fleet.network.budget
    if budget is None:
        return
    place = "network.budget"
    alone = worst_load(fleet, geometry, operator=False)
    watched = worst_load(fleet, geometry, operator=True)
    if alone.most > budget:
        yield Finding(
            "warning",
            place,
            f"{alone} with all headers, where {kbit(budget)} are to do each way: messages will queue, come "
            f"late and be lost; {_advice(fleet, geometry, operator=False)}",
        )
    elif watched.most > budget:
        yield Finding(
            "warning",
            place,
            f"{kbit(budget)} each way carry what robots say to each other, but not what an operator who "
            f"listens to all adds, as `handfast drive` does to record it: {watched}; "
            f"{_advice(fleet, geometry, operator=True)}",
        )
    if fleet.network.emulate_budget and any(robot.host is not None for robot in fleet.robots):
        yield Finding(
            "warning",
            "network.emulate_budget",
            "robots with a host have radios of their own: on these the emulated one comes on top",
        )


def _advice(fleet: Fleet, geometry: Geometry, *, operator: bool) -> str:
    sets = fitting_rates(fleet, geometry, operator=operator)
    if sets is None:
        routed = replace(fleet, network=replace(fleet.network, topology="routed"))
        if not fleet.is_routed and fitting_rates(routed, geometry, operator=operator) is not None:
            return "no rate fits in a mesh, where every listener gets a copy of its own: use routers"
        return "no rate fits: take fewer robots or edges, or more budget"
    text = f"this fits: {_words(fleet, geometry, sets)}"
    if not operator:
        watched = fitting_rates(fleet, geometry, operator=True)
        if watched is not None and watched != sets:
            text += f"; while an operator listens to all, this: {_words(fleet, geometry, watched)}"
    return text


def _words(fleet: Fleet, geometry: Geometry, sets: Mapping[str, float]) -> str:
    words = " ".join(f"--set {name}={value:g}" for name, value in sets.items())
    found = check_loop(with_rates(fleet, sets), geometry)
    unsound = any(each.place == "fleet.rate_hz" for each in found)
    return f"{words} (but the law wants a higher rate)" if unsound else words


def fitting_rates(fleet: Fleet, geometry: Geometry, *, operator: bool) -> dict[str, float] | None:
    """Settings with the highest rate (of `_lower_rates`) at which the budget carries everything; None if
    there is none.

    Beacons become fewer where the rate would have to be below `_GOOD_HZ` otherwise.
    """
    budget = fleet.network.budget
    assert budget is not None
    best: dict[str, float] | None = None
    enough = min(_GOOD_HZ, fleet.fleet.rate_hz)
    for beacons in (None, *(hz for hz in _BEACON_HZ if hz < fleet.avoidance.beacon_hz)):
        # Not by halving: at low rates robots brake later, so they listen to each other from further away.
        for rate in _lower_rates(fleet.fleet.rate_hz):
            if best is not None and rate <= best["fleet.rate_hz"]:
                break
            sets = _settings(fleet, rate, beacons)
            if worst_load(with_rates(fleet, sets), geometry, operator=operator).most <= budget:
                best = sets
                break
        if best is not None and best["fleet.rate_hz"] >= enough:
            break
    return best


def _lower_rates(rate_hz: float) -> Iterator[int]:
    """Rates to try, the highest first: in steps of about a twentieth, whole numbers."""
    rate = int(rate_hz)
    while rate >= 1:
        yield rate
        rate -= max(1, rate // 20)


def _settings(fleet: Fleet, rate_hz: float, beacon_hz: float | None) -> dict[str, float]:
    """What has to be set for these rates; None: beacons stay as they are."""
    sets = {"fleet.rate_hz": rate_hz}
    if beacon_hz is not None:
        sets["avoidance.beacon_hz"] = beacon_hz
    for name in ("plant_timeout_s", "wrench_timeout_s", "prediction_horizon_s"):
        if getattr(fleet.control, name) < 2.0 / rate_hz:
            sets[f"control.{name}"] = _PERIODS / rate_hz
    return sets


def with_rates(fleet: Fleet, sets: Mapping[str, float]) -> Fleet:
    """The fleet with numbers of its tables set, by TABLE.FIELD."""
    for name, value in sets.items():
        table, _, attribute = name.partition(".")
        fleet = replace(fleet, **{table: replace(getattr(fleet, table), **{attribute: value})})
    return fleet


# --- sizes ------------------------------------------------------------------------------------


def _size(message: Message) -> int:
    return len(encode(message))


def _hand_bytes(fleet: Fleet, robot: int, near: Set[int]) -> float:
    """One hand state on average: it echoes what was heard once in `HEARD_ROUNDS`."""
    multipliers = tuple((other, 0.1) for other in fleet.neighbours(robot))
    heard = tuple((other, _ECHO_US) for other in sorted(near))
    hand = HandState(robot, _ROUND, _NOW_NS, True, len(multipliers), *(0.1,) * 11, multipliers, ())
    return (_size(hand._replace(heard=heard)) + (HEARD_ROUNDS - 1) * _size(hand)) / HEARD_ROUNDS


def _beacon_bytes(robot: int) -> int:
    return _size(Beacon(robot, _ROUND, _NOW_NS, True, *(0.1,) * 5, _NOW_NS, 2**31, -1, -1))


def _wrench(robot: int) -> Wrench:
    return Wrench(robot, _ROUND, _NOW_NS, 0.1, 0.1, False, (_NOW_NS, _NOW_NS))


def _plant_state(robot: int) -> PlantState:
    return PlantState(robot, _ROUND, _NOW_NS, *(0.1,) * 7, True, True, True, "")


def _status(fleet: Fleet, robot: int) -> Status:
    """One of an uneventful drive: it tells of each tick since the last, and of each neighbour in each."""
    neighbours, ticks = fleet.neighbours(robot), round(fleet.fleet.rate_hz / STATUS_HZ)
    rows = tuple(NeighbourStatus(other, _ECHO_US, 10_000, 10, 100, 200) for other in neighbours)
    ages_us = (_ECHO_US,) * (ticks * len(neighbours))
    counted = tuple(Total(name, 10_000) for name in _COUNTERS)
    return Status(
        robot, 1000, _NOW_NS, "running", "", "", _NOW_NS, -1, rows, (300,) * ticks, ages_us, counted
    )


def _tells_truth(fleet: Fleet, robot: int) -> bool:
    """Whether its plant says where the body really is, beside what it measures."""
    body = fleet.robot(robot)
    return any(
        (body.position_noise_m, body.heading_noise_rad, body.speed_noise_mps, body.yaw_rate_noise_radps)
    )
