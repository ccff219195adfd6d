"""A flood of the ports of a fleet on hosts, from a computer of its network that is none of the fleet's."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from handfast.agent.fleet.loading import load_fleet
from tests.hosts.fleet_on_hosts import FleetOnHosts
from tests.hosts.host import Host
from tests.process.flooding import flooding, targets_of

SETTLED_S: Final = 2.0
"""What the flood takes to fill what waits at the ports."""


@contextmanager
def flood(stranger: Host, fleet: FleetOnHosts, per_s: int, settled_s: float = SETTLED_S) -> Iterator[None]:
    """Handshakes that fail, so many a second, at the ports of all agents and plants together."""
    known = load_fleet(fleet.file)
    endpoints = [ends(robot) for robot in known.ids for ends in (known.agent_endpoint, known.plant_endpoint)]
    # With this machine's files.
    with flooding(targets_of(endpoints), per_s, "broken", inside=stranger.space.command("net")):
        time.sleep(settled_s)
        yield
