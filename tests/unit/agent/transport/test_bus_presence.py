"""Who is there, by liveliness tokens that anybody may declare."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

import zenoh

from handfast.agent.messages import key_expressions
from handfast.agent.transport.bus import PRESENCE_SIZE, Presence


class Subscriber:
    """Changes that wait."""

    def __init__(self) -> None:
        self.waiting: deque[Any] = deque()
        self.handler = self

    def change(self, key: str, *, here: bool = True) -> None:
        kind = zenoh.SampleKind.PUT if here else zenoh.SampleKind.DELETE
        self.waiting.append(SimpleNamespace(key_expr=key, kind=kind))

    def try_recv(self) -> Any:
        return self.waiting.popleft() if self.waiting else None


def test_tokens_that_stand_for_no_process_are_left_out() -> None:
    subscriber = Subscriber()
    presence = Presence(subscriber)
    agent = key_expressions.alive("f", 2, "agent")
    for key in (
        agent,
        key_expressions.alive("f", 2, "other"),
        key_expressions.alive("f", "*", "agent"),
        "f/alive/robot/2/agent/x",
    ):
        subscriber.change(key)
    assert presence.update() == [(agent, True)]
    assert presence.alive == {agent}
    subscriber.change(agent, here=False)
    assert presence.update() == [(agent, False)]
    assert presence.alive == set()


def test_a_flood_keeps_no_loop_and_no_memory() -> None:
    subscriber = Subscriber()
    presence = Presence(subscriber)
    for robot in range(3 * PRESENCE_SIZE):
        subscriber.change(key_expressions.alive("f", robot, "agent"))
    assert len(presence.update()) == PRESENCE_SIZE
    for _ in range(3):
        presence.update()
    assert len(presence.alive) == PRESENCE_SIZE
    one = key_expressions.alive("f", 1, "agent")
    for number in range(2 * PRESENCE_SIZE):
        subscriber.change(one, here=number % 2 == 1)
    assert len(presence.update()) == PRESENCE_SIZE
    assert len(presence.update()) == PRESENCE_SIZE
