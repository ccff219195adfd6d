"""A robot that lies about the orders it knows keeps nobody from stopping the fleet."""

from __future__ import annotations

import pytest

from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import AHEAD_US_MAX, decode, encode
from handfast.agent.messages.types import TIME_NS_MAX, Beacon, Mission, Resume, Status, Stop
from handfast.deploy.orders.operator import Operator
from handfast.deploy.orders.stop_outcome import Stopping
from tests.process.small_fleets import triangle

NOW_NS = 1_790_000_000_000_000_000
NOW_US = NOW_NS // 1_000
LIES = (NOW_US + 2 * AHEAD_US_MAX, TIME_NS_MAX - 1)
FLEET = resolved(triangle())
NAME = FLEET.fleet.name


def status(robot: int, order_version: int, state: str = "running") -> Status:
    return Status(robot, 1, NOW_NS, state, "", "", order_version, order_version, (), (), (), ())


def beacon(version: int) -> Beacon:
    return Beacon(2, 1, NOW_NS, True, 0.0, 0.0, 0.0, 0.0, 0.0, version, 0, version, version)


@pytest.mark.parametrize("lie", [*LIES, 2**64 - 1])
def test_an_operator_orders_what_robots_take(lie: int) -> None:
    operator = Operator(FLEET, resolve(FLEET))
    operator.hear(key_expressions.status(NAME, 2), status(2, lie))
    if lie < TIME_NS_MAX:
        operator.hear(key_expressions.beacon(NAME, 2), beacon(lie))
    last = 0
    for order in (
        operator.order_stop(NOW_NS, "a test"),
        operator.order_resume(NOW_NS, ()),
        operator.order_stop(NOW_NS + 1, "again"),
    ):
        taken = decode(encode(order))
        assert isinstance(taken, Stop | Resume)
        assert taken.version > last
        last = taken.version
    assert isinstance(decode(encode(operator.begin(NOW_NS, NOW_NS, 1))), Mission)


def test_what_can_be_is_outdone() -> None:
    operator = Operator(FLEET, resolve(FLEET))
    operator.hear(key_expressions.status(NAME, 2), status(2, NOW_US + 1_000_000))
    assert operator.order_stop(NOW_NS, "a test").version == NOW_US + 1_000_001
    stopping = Stopping(FLEET, NOW_NS, "a test")
    stopping.feed(NOW_NS, key_expressions.status(NAME, 2), status(2, NOW_US + 1_000_000))
    assert stopping.message.version == NOW_US + 1_000_001


@pytest.mark.parametrize("lie", LIES)
def test_a_stop_is_not_changed_for_a_lie(lie: int) -> None:
    stopping = Stopping(FLEET, NOW_NS, "a test")
    stopping.feed(NOW_NS, key_expressions.status(NAME, 2), status(2, lie))
    assert stopping.message.version == NOW_US
    stopping.feed(NOW_NS, key_expressions.status(NAME, 1), status(1, NOW_US, "stopping"))
    assert not stopping.stands_by(2)
