"""What the messages of a fleet take of a robot's radio (PURE).

Counted are the bytes that IP carries. What a radio adds below it is not: headers of its frames, contention,
repeats. The constants were measured on sockets of eclipse-zenoh 1.10.2, plain and with TLS 1.3.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry
from handfast.agent.messages.codec import encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import HEARD_ROUNDS, Beacon, HandState, PlantState, Wrench
from handfast.deploy.check.load.network import beacon_hz, listeners, neighbours

_NOW_NS: Final = 1_790_000_000_000_000_000
_PACKET_BYTES: Final = 64
"""Bytes around a message that travels alone: 12 of Zenoh, 40 of IPv4 and TCP, 12 of TCP's time stamps."""
_TLS_BYTES: Final = 22
"""Bytes of a TLS 1.3 record: header 5, type 1, tag 16."""
_JOINED_BYTES: Final = 5
"""Bytes around a message that travels in the packet of another."""
_ACKNOWLEDGED_BYTES: Final = 0.75 * 52
"""Mean size of the acknowledgement of a packet: three quarters of them are packets of their own."""


def describe_radio(fleet: Fleet, geometry: Geometry) -> str:
    """Return what the busiest radio carries at the start of the drive, in a line."""
    robot, sent, received = max(radio_loads(fleet, geometry), key=lambda load: max(load[1:]))
    operator = 8e-3 * _operator_bytes(fleet)
    return (
        f"robot {robot} sends about {sent / 1e3:.3g} kbit/s and receives {received / 1e3:.3g} kbit/s, with "
        f"all headers; an operator who records adds {operator:.3g} kbit/s to what each robot sends"
    )


def radio_loads(fleet: Fleet, geometry: Geometry) -> list[tuple[int, float, float]]:
    """Return for each robot its number and what it sends and receives in bit/s while nobody is silent.

    The robots stand where they start, where more of them listen to each other than at their places.
    """
    rate, beacons = fleet.fleet.rate_hz, beacon_hz(fleet)
    near, joined = listeners(fleet, geometry, at_start=True), neighbours(fleet, geometry)
    headers = _PACKET_BYTES + (_TLS_BYTES if fleet.is_secured else 0)
    hands = {robot: hand_bytes(fleet, joined[robot], near[robot]) + headers for robot in fleet.ids}
    orders = (_NOW_NS, 2**31, -1, -1)
    beacon = len(encode(Beacon(fleet.ids[0], FIRST_ROUND, _NOW_NS, True, *(0.1,) * 5, *orders)))
    others = len(fleet.ids) - 1
    loads = []
    for robot, heard in near.items():
        far = others - len(heard)
        # A beacon travels with the hand state of its tick to those who listen to both.
        received = rate * sum(hands[other] for other in heard)
        received += beacons * (len(heard) * (beacon + _JOINED_BYTES) + far * (beacon + headers))
        packets_received = rate * len(heard) + beacons * far
        most = 1 if fleet.is_routed else others
        copies, all_copies = min(most, len(heard)), min(most, others)
        sent = rate * copies * hands[robot]
        sent += beacons * (copies * (beacon + _JOINED_BYTES) + (all_copies - copies) * (beacon + headers))
        packets_sent = rate * copies + beacons * (all_copies - copies)
        sent += packets_received * _ACKNOWLEDGED_BYTES
        received += packets_sent * _ACKNOWLEDGED_BYTES
        loads.append((robot, 8.0 * sent, 8.0 * received))
    return loads


def hand_bytes(fleet: Fleet, joined: set[int], near: set[int]) -> float:
    """Return the mean size of a hand state, without headers.

    Args:
        joined: robots at the other ends of the sender's edges.
        near: robots that the sender hears; it echoes their stamps once in `HEARD_ROUNDS`.
    """
    multipliers, heard = tuple((other, 0.1) for other in joined), tuple((other, 20_000) for other in near)
    hand = HandState(fleet.ids[0], FIRST_ROUND, _NOW_NS, True, len(joined), *(0.1,) * 11, multipliers, ())
    if any(robot.kind.rolls_on_s for robot in fleet.robots):
        hand = hand._replace(obeys=((0.1,) * 3,))
    with_echo, without = len(encode(hand._replace(heard=heard))), len(encode(hand))
    return (with_echo + (HEARD_ROUNDS - 1) * without) / HEARD_ROUNDS


def _operator_bytes(fleet: Fleet) -> float:
    """Bytes a second that an operator who listens to everything adds to what a robot sends, at most."""
    robot = fleet.ids[0]
    hand = 0.0 if fleet.is_routed else hand_bytes(fleet, set(), set(fleet.ids))
    wrench = len(encode(Wrench(robot, FIRST_ROUND, _NOW_NS, 0.1, 0.1, False, (_NOW_NS, _NOW_NS))))
    state = len(encode(PlantState(robot, FIRST_ROUND, _NOW_NS, *(0.1,) * 7, True, True, True, "", ())))
    headers = _PACKET_BYTES + (_TLS_BYTES if fleet.is_secured else 0)
    return fleet.fleet.rate_hz * (hand + wrench + state + 2 * headers)
