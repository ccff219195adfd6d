"""What a fleet's network carries: links, and the messages that a robot hears (PURE)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from handfast.agent.control.limits import sensing_distance
from handfast.agent.fleet.hosts import MESH_ROBOTS_MAX
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, resolve, start_hands
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
