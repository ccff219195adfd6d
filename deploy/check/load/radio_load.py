"""What the robots' radios carry (PURE).

Bytes on the link, as `agent.links.wire_size` counts them. All stand where they start or at their places,
nobody is silent, no fault rule holds, and no order has just been given: that is what goes on all the time.
Robots that pass each other in between listen to each other as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Final, NamedTuple

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
    SILENT_MAX,
    Beacon,
    HandState,
    Message,
    NeighbourStatus,
    PlantState,
    Silent,
    Status,
    Total,
    Wrench,
)
from agent.supervision.status import status_hz
from deploy.check.load.network import beacon_hz, listeners, neighbours

_NOW_NS: Final = 1_790_000_000_000_000_000
_ROUND: Final = FIRST_ROUND + 10_000
_ECHO_US: Final = 20_000
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
    """What the radio of a robot sends and receives, bit/s; `at_start` or, if not that, at its place."""

    robot: int
    up: float
    down: float
    at_start: bool = False

    @property
    def most(self) -> float:
        """The way that carries more."""
        return max(self.up, self.down)

    def __str__(self) -> str:
        where = " at the start" if self.at_start else ""
        return f"robot {self.robot} sends {kbit(self.up)} and receives {kbit(self.down)}{where}"


def kbit(bits_per_second: float) -> str:
    """In kbit/s, or in Mbit/s from 1000 of these on, in three digits."""
    if bits_per_second < 999_500.0:
        return f"{bits_per_second / 1e3:.3g} kbit/s"
    return f"{bits_per_second / 1e6:.4g} Mbit/s"


def radio_loads(
    fleet: Fleet,
    geometry: Geometry,
    *,
    at_start: bool = False,
    operator: bool = False,
    silences: bool = False,
) -> list[RadioLoad]:
    """Of every robot, in the order of the file.

    Args:
        at_start: while robots are where they start, not at their places.
        operator: whether one listens to all, as `handfast drive` does to record it.
        silences: whether so many robots are silent that beacons tell of as many as they can; they come as
            often as they may then, in large fleets too.
    """
    joined, listened = neighbours(fleet, geometry), listeners(fleet, geometry, at_start=at_start)
    hands = {robot: _hand_bytes(fleet, robot, joined[robot], listened[robot]) for robot in fleet.ids}
    beacons = beacon_hz(fleet), _beacon_bytes(fleet, 0)
    if silences:
        told = min(SILENT_MAX, max(0, len(fleet.ids) - 2))
        beacons = fleet.fleet.rate_hz / fleet.beacon_rounds, _beacon_bytes(fleet, told)
    loads = []
    for robot in fleet.ids:
        status = _status_bytes(fleet, robot, joined[robot]) if operator else None
        load = _load(fleet, robot, listened[robot], hands, beacons, status)
        loads.append(load._replace(at_start=at_start))
    return loads


def worst_load(
    fleet: Fleet, geometry: Geometry, *, operator: bool = False, silences: bool = False
) -> RadioLoad:
    """Of the robot whose radio carries most, at its place or at the start; arguments as of `radio_loads`."""
    loads = [
        load
        for at_start in (False, True)
        for load in radio_loads(fleet, geometry, at_start=at_start, operator=operator, silences=silences)
    ]
    return max(loads, key=lambda load: load.most)


def _load(
    fleet: Fleet,
    robot: int,
    near: Set[int],
    hands: Mapping[int, float],
    beacons: tuple[float, int],
    status: int | None,
) -> RadioLoad:
    """Of one robot that listens to those in `near`.

    Args:
        hands: bytes of a hand state, by who says it.
        beacons: how often (Hz) they come from every robot, and their bytes.
        status: its bytes; none goes where no operator listens.
    """
    up, down = _streams(fleet, robot, near, hands, beacons, status)
    secured = fleet.is_secured
    links, idle = _idle(fleet, near, beacons[0])
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


def _idle(fleet: Fleet, near: Set[int], beacons_hz: float) -> tuple[int, float]:
    """Links on which less goes than signs of life would, each way, and how often one of these goes then."""
    others = len(fleet.robots) - 1
    if fleet.is_routed or not others:
        return 0, 0.0
    return others - len(near), max(0.0, KEEP_ALIVE_HZ - beacons_hz)


def _streams(
    fleet: Fleet,
    robot: int,
    near: Set[int],
    hands: Mapping[int, float],
    beacons: tuple[float, int],
    status: int | None,
) -> tuple[list[Stream], list[Stream]]:
    """What leaves a robot, and what comes to it."""
    rate, (beacons_hz, beacon) = fleet.fleet.rate_hz, beacons
    others, operator = len(fleet.robots) - 1, status is not None
    # Of what is said on links to routers they make a copy for each; in a mesh its sender does.
    hearers, all_others = len(near) + operator, others + operator
    if fleet.is_routed:
        hearers, all_others = min(1, hearers), min(1, all_others)
    up = [Stream(rate, hearers, hands[robot]), Stream(beacons_hz, all_others, beacon, hearers)]
    if status is not None:
        up += [
            Stream(rate, 1, _size(_wrench(robot)), 1),
            Stream(status_hz(len(fleet.robots)), 1, status, 1),
            Stream(rate, 1, _size(_plant_state(fleet, robot))),  # from another process
        ]
        if _tells_truth(fleet, robot):
            up.append(Stream(rate, 1, _size(_plant_state(fleet, robot)), 1))
    down = [Stream(rate, 1, hands[other]) for other in sorted(near)]
    down.append(Stream(beacons_hz, others, beacon, len(near)))
    return up, down


# --- sizes ------------------------------------------------------------------------------------


def _size(message: Message) -> int:
    return len(encode(message))


def _hand_bytes(fleet: Fleet, robot: int, joined: Set[int], near: Set[int]) -> float:
    """One hand state on average: it echoes what was heard once in `HEARD_ROUNDS`."""
    multipliers = tuple((other, 0.1) for other in sorted(joined))
    heard = tuple((other, _ECHO_US) for other in sorted(near))
    hand = HandState(robot, _ROUND, _NOW_NS, True, len(multipliers), *(0.1,) * 11, multipliers, ())
    if fleet.robot(robot).kind.rolls_on_s:
        hand = hand._replace(obeys=((0.1,) * 3,))
    return (_size(hand._replace(heard=heard)) + (HEARD_ROUNDS - 1) * _size(hand)) / HEARD_ROUNDS


def _beacon_bytes(fleet: Fleet, silent: int) -> int:
    """One that tells of so many silent robots."""
    robot = max(fleet.ids)
    told = Silent(robot, _NOW_NS, True, *(0.1,) * 7)
    orders = (_NOW_NS, 2**31, -1, -1)
    rolling = ((robot, 0.1, 0.1, 0.1),) if fleet.robot(robot).kind.rolls_on_s else ()
    beacon = Beacon(robot, _ROUND, _NOW_NS, True, *(0.1,) * 5, *orders, (told,) * silent)
    return _size(beacon._replace(rolling=rolling * (1 + silent)))


def _wrench(robot: int) -> Wrench:
    return Wrench(robot, _ROUND, _NOW_NS, 0.1, 0.1, False, (_NOW_NS, _NOW_NS))


def _plant_state(fleet: Fleet, robot: int) -> PlantState:
    asked = ((0.1, 0.1),) if fleet.robot(robot).kind.rolls_on_s else ()
    return PlantState(robot, _ROUND, _NOW_NS, *(0.1,) * 7, True, True, True, "", asked)


def _status_bytes(fleet: Fleet, robot: int, joined: Set[int]) -> int:
    """One of an uneventful drive: it tells of each tick since the last, and of each neighbour in each."""
    ticks = round(fleet.fleet.rate_hz / status_hz(len(fleet.robots)))
    rows = tuple(NeighbourStatus(other, _ECHO_US, 10_000, 10, 100, 200) for other in joined)
    ages_us = (_ECHO_US,) * (ticks * len(rows))
    counted = tuple(Total(name, 10_000) for name in _COUNTERS)
    orders = (_NOW_NS, -1)
    durations_us = (300,) * ticks
    return _size(
        Status(robot, 1000, _NOW_NS, "running", "", "", *orders, rows, durations_us, ages_us, counted)
    )


def _tells_truth(fleet: Fleet, robot: int) -> bool:
    """Whether its plant says where the body really is, beside what it measures."""
    body = fleet.robot(robot)
    return any(
        (body.position_noise_m, body.heading_noise_rad, body.speed_noise_mps, body.yaw_rate_noise_radps)
    )
