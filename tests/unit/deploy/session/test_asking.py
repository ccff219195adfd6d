"""How often a session asks a fleet for its orders: an answer costs all robots of a large one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from handfast.agent.messages.types import Ask, Message, Status
from handfast.deploy.orders.operator import Operator
from handfast.deploy.session.operator_session import ASK_S, SEND_PERIOD_S, OperatorSession


class Listening(OperatorSession):
    """Without a bus: of each wait it is given what is heard in it, whether orders are missing, and who has
    told its status."""

    def __init__(self, heard: list[tuple[bool, set[int]]]) -> None:
        self._coming = heard
        self.alive = {(1, "agent"), (2, "agent")}
        self.fleet = SimpleNamespace(ids=(1, 2))  # type: ignore[misc, assignment]
        self.operator = cast(Operator, SimpleNamespace(behind=False, stop_in_force=None))  # type: ignore[misc]
        self.statuses: dict[int, Status] = {}
        self.author = "Ada"  # type: ignore[misc]
        self.asked: list[int] = []
        self.waits = 0

    def now_ns(self) -> int:
        return self.waits

    def say(self, message: Message) -> None:
        assert type(message) is Ask
        self.asked.append(self.waits)

    def wait(self, look: object, timeout_s: float) -> bool:
        assert timeout_s == SEND_PERIOD_S
        self.waits += 1
        if self._coming:
            self.operator.behind, robots = self._coming.pop(0)  # type: ignore[misc]
            self.statuses |= dict.fromkeys(robots, cast(Status, None))
        return self._informed()


@pytest.mark.parametrize(
    ("heard", "asked"),
    [
        ([(False, {1, 2})], [0]),
        ([(False, {1}), (False, set()), (False, {2})], [0]),
        ([(True, {1, 2}), (False, set())], [0, 1]),
        ([(False, {1}), (True, {2}), (True, set()), (False, set())], [0, 2, 3]),
    ],
    ids=["all is known", "a status comes late", "an answer was lost", "and again"],
)
def test_it_asks_again_where_an_answer_is_missing(
    heard: list[tuple[bool, set[int]]], asked: list[int]
) -> None:
    session = Listening(heard)
    session.ask()
    assert session.asked == asked


def test_nor_is_it_waited_for_ever() -> None:
    session = Listening([])
    session.ask()
    assert session.asked == [0]
    assert session.waits == round(ASK_S / SEND_PERIOD_S)
