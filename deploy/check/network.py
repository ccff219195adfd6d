"""Network load of a fleet: links, messages that each robot hears, bytes on its radio (PURE).

The bytes are those that IP carries. Frame headers, contention and retransmissions of a radio are not
included. The constants were measured on sockets of eclipse-zenoh 1.10.2, plain and with TLS 1.3.

The plants of a large fleet on one machine share processes (`plant.pool`): with a process each they take a
fifth of the machine, with shared processes a twentieth (docs/architecture.md). In a small fleet each has a
process of its own, which can be killed, paused and observed by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil
from typing import Final, NamedTuple

import numpy as np

from handfast.agent.control.limits import sensing_distance
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, CLOCK_FIELDS
from handfast.agent.fleet.hosts import MESH_ROBOTS_MAX
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, resolve, start_hands
from handfast.agent.messages.codec import encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import HEARD_ROUNDS, Beacon, HandState, PlantState, Wrench
from handfast.agent.supervision.state_machine import status_hz
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.safety import parting


class Load(NamedTuple):
    """What links and robots have to carry while all is well, and robots move as others expect.

    Attributes:
        links: between processes of the fleet, an operator's left out.
        hands, beacons, own: messages a second that an agent hears, on average over the robots: hand states
            of those that it listens to, others' beacons, its plant's states.
        batches: messages a second in which those come that routers pass on in batches; batched: how many
            are in them.
        routed: messages a second that all routers pass on, to robots and one operator.
        recorded: messages a second that an operator hears.
    """

    links: int
    hands: float
    beacons: float
    own: float
    batches: float
    batched: float
    routed: float
    recorded: float

    @property
    def alone(self) -> float:
        """Messages a second that an agent hears one by one."""
        return self.hands + self.beacons + self.own - self.batched


def beacon_hz(fleet: Fleet) -> float:
    """How often a robot says its beacon while it moves as others expect."""
    return fleet.fleet.rate_hz / fleet.beacon_rounds_max


def neighbours(fleet: Fleet, geometry: Geometry) -> dict[int, set[int]]:
    """With whom each robot shares an edge."""
    found: dict[int, set[int]] = {robot: set() for robot in fleet.ids}
    for i, j in geometry.edges.tolist():
        one, other = geometry.ids[i], geometry.ids[j]
        found[one].add(other)
        found[other].add(one)
    return found


def listeners(fleet: Fleet, geometry: Geometry, *, at_start: bool = False) -> dict[int, set[int]]:
    """Whose hand states each robot listens to at the places or at the start; these listen to its own."""
    found = neighbours(fleet, geometry)
    if not fleet.avoidance.enabled:
        return found
    ids = geometry.ids
    x, y = (start_hands(fleet) if at_start else geometry.offsets).T
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    near = np.argwhere(apart < sensing_distance(fleet, parting(fleet, geometry)[0]))
    for i, j in near.tolist():
        if i != j:
            found[ids[i]].add(ids[j])
    return found


def load_of(fleet: Fleet, robots: int | None = None) -> Load:
    """What the network of `fleet` carries while all are at their places, or that of one of as many robots
    like these. Robots that pass each other hear more of each other.

    Raises:
        handfast.agent.fleet.model.FleetError: its formation cannot be resolved.
    """
    there, rate, each_hz = len(fleet.robots), fleet.fleet.rate_hz, beacon_hz(fleet)
    n = there if robots is None else robots
    hands = sum(map(len, listeners(fleet, resolve(fleet)).values())) / there * rate
    beacons = (max(n, there) - 1) * each_hz
    # An operator listens to all: hand state, wrench and the plant's state, beacon and status.
    recorded = n * (3.0 * rate + each_hz) + n * status_hz(n)
    if not fleet.is_routed:
        return Load(n * (n - 1) // 2 + n, hands, beacons, rate, 0.0, 0.0, 0.0, recorded)
    batches = batched = gathered = 0.0
    if fleet.batches_beacons:  # at most one batch a round
        batches, batched, gathered = min(rate, n * each_hz), beacons, n * each_hz
    if fleet.batches_hands:
        batches, batched, gathered = batches + rate, batched + hands, gathered + n * rate
    routed = n * (hands + beacons - batched + batches) + gathered + recorded
    return Load(3 * n, hands, beacons, rate, batches, batched, routed, recorded)


def describe_links(fleet: Fleet) -> str:
    """What the network carries, in a line."""
    load = load_of(fleet)
    places = [router.where if router.host is None else router.host for router in fleet.routers]
    if not fleet.is_routed:
        text = "a mesh"
    elif places:
        text = f"routed by {' or '.join(places)}"
    else:
        text = "routed by a router that `handfast run` starts"
    hands = "hand states" if fleet.control.send == "periodic" else "hand states while it settles, few then"
    heard = [(load.hands, hands), (load.beacons, "beacons"), (load.own, "states of its plant")]
    text += f": {load.links} link{'s' * (load.links != 1)}; a robot hears "
    text += f"{', '.join(f'{rate:.0f} {what}' for rate, what in heard if rate)} a second"
    if load.batches:
        what = "both" if fleet.batches_hands else "beacons"
        text += f" ({what} in {load.batches:.0f} batches)"
    return text + (f", routers pass on {load.routed:.0f}" if load.routed else "")


def describe_topology(fleet: Fleet) -> str:
    """Which topology it is, why, and who starts its routers, in a line."""
    if fleet.network.topology is not None:
        why = "as network.topology says"
    elif fleet.network.routers:
        why = "as network.routers names some"
    else:
        why = f"for {'more than' if fleet.is_routed else 'at most'} {MESH_ROBOTS_MAX} robots"
    if not fleet.is_routed:
        return f"a mesh, {why}"
    hosts = [router.host for router in fleet.routers if router.host is not None]
    starts = f"; `handfast up` starts routers on {' and '.join(hosts)}" if hosts else ""
    return f"routed, {why}{starts}"


def check_network(fleet: Fleet) -> Iterator[Finding]:
    """Warns of a mesh that is too large."""
    n = len(fleet.robots)
    if fleet.is_routed or n <= MESH_ROBOTS_MAX:
        return
    yield Finding(
        "warning",
        "network",
        f"{n} robots are linked each to each; {MESH_ROBOTS_MAX} are as many as go well together: leave out "
        "network.topology",
    )


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


STEPS_HZ: Final = 500.0
"""So many steps a second does one process at most: all bodies of a process tick at once, and the last of them
must not be late. A step takes some 0.1 ms."""


def sharing(fleet: Fleet) -> list[tuple[int, ...]]:
    """The robots whose bodies share a process, those of each process together; each of the others has one of
    its own. None do in a fleet that is no larger than a mesh may be, nor in a mesh: what they share listens
    nowhere, and is heard through a router.

    A body that a rule of the file kills, freezes or gives another clock has its own process, as have those
    that are plugins or real.
    """
    if not fleet.is_routed or len(fleet.robots) <= MESH_ROBOTS_MAX:
        return []
    own = _by_rule(fleet)
    simulated = [
        robot.id
        for robot in fleet.robots
        if robot.id not in own and robot.kind.body and not (robot.kind.vehicle or robot.kind.is_plugin)
    ]
    count = ceil(len(simulated) / max(1, int(STEPS_HZ / fleet.fleet.rate_hz)))
    size = ceil(len(simulated) / max(1, count))
    parts = [tuple(simulated[k : k + size]) for k in range(0, len(simulated), max(1, size))]
    return [part for part in parts if len(part) > 1]


def _by_rule(fleet: Fleet) -> set[int]:
    """Robots whose plant's process a rule of the file does something to."""
    found: set[int] = set()
    for rule in fleet.faults.rules:
        named: Sequence[int] = fleet.ids if rule.robots is None else rule.robots
        actions = [getattr(rule, field) for field in rule.given(ACTION_FIELDS)]
        if rule.given(CLOCK_FIELDS) or any(role != "agent" for role in actions):
            found.update(named)
    return found
