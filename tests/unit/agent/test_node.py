"""handfast.agent.node: how much waits for a tick."""

from __future__ import annotations

from handfast.agent.node import EACH, INBOX_SIZE, inbox_size


def test_what_all_robots_say_has_room_for_each() -> None:
    assert inbox_size("f/robot/7/hand", 500) == INBOX_SIZE
    assert inbox_size("f/robot/*/beacon", 6) == INBOX_SIZE
    assert inbox_size("f/robot/*/beacon", 100) == EACH * 100
