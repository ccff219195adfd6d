"""A flood of connections that lasts: a robot holds no more of them than it has places for, so that its memory
stays as it is and its own files can be opened: a stop that is laid on its disk gets through."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from agent.messages.codec import encode
from agent.messages.types import PlantState, Stop
from agent.runtime.order_store import STOP_FILE, packed
from agent.security.private_files import write
from agent.transport.listening_gate import EACH, WAITING
from tests.process import attackers
from tests.process.flooding import flooding, targets_of
from tests.process.harness import measured
from tests.process.secured_fleet import SecuredRobots, secured_robots, three

pytestmark = pytest.mark.long

PER_S = 300
OWN = 40
"""A process has fewer open of its own."""


def opened(fleet: SecuredRobots, robot: int, role: str) -> int:
    return len(list(Path(f"/proc/{fleet.processes[robot, role].pid}/fd").iterdir()))


def test_a_stop_on_the_disk_gets_through_a_flood_that_lasts(tmp_path: Path) -> None:
    with secured_robots(three("fleet.rate_hz=25"), tmp_path / "r") as fleet:
        fleet.drive()
        most = OWN + WAITING + EACH * 3 + PER_S // 2
        roles = ("agent", "plant")
        # Strangers begin handshakes with both processes of a robot, and do not go on.
        with flooding(targets_of(fleet.endpoints[1, role] for role in roles), PER_S, "hello"):
            fleet.wait(
                lambda: all(opened(fleet, 1, role) >= WAITING for role in roles), "its places are taken"
            )
            until = time.monotonic() + 5.0
            fleet.wait(lambda: time.monotonic() > until, "the flood lasts")
            assert all(opened(fleet, 1, role) <= most for role in roles)
            now_ns = time.time_ns()
            stop = encode(Stop(now_ns // 1_000, now_ns, "laid there"))
            by = fleet.keys.files(fleet.keys.operator())
            write(fleet.folder / "orders" / STOP_FILE, packed([attackers.sealed(by, stop, now_ns)]))
            took_s, _ = fleet.first(now_ns, PlantState, 1, lambda m: not m.driving, "it brakes")
            measured("a stop by its disk under a flood, s", took_s)
            fleet.wait_until_all("stopped")
            assert "nobody new is let in" in fleet.log_of(1, "agent")
        # And when it is over the port is soon as it was.
        begun = time.monotonic()
        fleet.wait(lambda: opened(fleet, 1, "agent") < OWN, "all that has waited was looked at")
        measured("what waited after a flood, s", time.monotonic() - begun)
        assert "cannot read" not in fleet.log_of(1, "agent") + fleet.log_of(1, "plant")
        assert not fleet.died()
