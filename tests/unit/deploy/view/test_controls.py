"""What pages order is given once, however often it is said; what is no order is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handfast.agent.messages.types import Message, Mission, Resume, Stop
from handfast.deploy.view.controls import ID_MAX, REASON_MAX, Controls
from tests.unit.deploy.orders.order_fleets import S
from tests.unit.deploy.view.running import Running
from tests.unit.deploy.view.test_orders import Way, begun, brake, stopped


class Made:
    """Controls of a fleet that drives, what they tell, and the ways that they made."""

    def __init__(self, running: Running) -> None:
        self.running = running
        self.ways: list[Way] = []
        self.told: list[dict[str, Any]] = []
        self.controls = Controls(running.state, self._ways, self._tell)
        running.live.listeners.append(self.controls.feed)

    def _ways(self) -> list[Way]:
        self.ways.append(Way())
        return [self.ways[-1]]

    def _tell(self, told: Sequence[dict[str, Any]]) -> None:
        self.told = json.loads(json.dumps(told))

    def take(self, content: dict[str, Any]) -> None:
        """What a page says that shows the fleet as it is, unless it says otherwise."""
        self.controls.take({"seen_s": self.running.clock.ns / S, **content})

    def step(self, after_ns: int = S // 20) -> None:
        self.running.step(after_ns)
        self.controls.step()

    def of(self, name: str) -> dict[str, Any]:
        (found,) = [each for each in self.told if each["id"] == name]
        return found


@pytest.fixture
def made() -> Iterator[Made]:
    with Running() as running:
        running.come()
        begun(running)
        yield Made(running)


# ---------------------------------------------------------------------- once


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        ({"kind": "stop", "reason": "a person"}, Stop),
        ({"kind": "resume"}, Resume),
        ({"kind": "leave", "robot": 4}, Mission),
        ({"kind": "join", "robot": 7, "edges": [1, 2]}, Mission),
        ({"kind": "reshape", "scale": 1.5}, Mission),
    ],
)
def test_an_order_is_given_once_however_often_it_is_said(
    made: Made, content: dict[str, Any], kind: type[Message]
) -> None:
    for _ in range(3):
        made.take({"id": "a", **content})
        made.step()
    assert len({each.version for each in made.running.of(kind)}) == 1
    assert [each["id"] for each in made.told] == ["a"]
    made.take({"id": "b", **content})
    assert [each["id"] for each in made.told] == ["a", "b"]


def test_a_stop_is_told_as_it_goes(made: Made) -> None:
    made.take({"id": "a", "kind": "stop"})
    assert len(made.running.of(Stop)) == 1  # before anything else is done
    (way,) = made.ways
    assert len(way.sent) == 1
    about = made.of("a")
    assert (about["kind"], about["what"], about["count"]) == ("stop", "stop", [0, 6])
    assert (about["over"], about["done"]) == (False, False)
    version = made.running.of(Stop)[0].version
    brake(made.running, version, 1, 2, 3)
    made.step()
    assert (made.of("a")["count"], made.of("a")["over"]) == ([3, 6], False)
    brake(made.running, version, 4, 7, 8)
    made.step()
    assert (made.of("a")["count"], made.of("a")["over"], made.of("a")["done"]) == ([6, 6], True, True)
    assert way.closed == 1


# ---------------------------------------------------------------------- how many


# ---------------------------------------------------------------------- what is none


@pytest.mark.parametrize("kind", ["dance", "", "Stop", None, 1, [], {}, ["stop"], "x" * 10_000])
def test_what_cannot_be_ordered_is_refused(made: Made, kind: object) -> None:
    made.take({"id": "a", "kind": kind})
    about = made.of("a")
    assert (about["over"], about["done"]) == (True, False)
    assert about["lines"] == [
        "nothing that can be ordered here; there are stop, resume, join, leave, replace, remove, reshape"
    ]
    assert len(about["kind"]) <= ID_MAX
    assert made.running.bus.said == []


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ({"kind": "leave"}, "robot: is missing"),
        ({"kind": "leave", "robot": 99}, "robot: there is no robot 99"),
        ({"kind": "leave", "robot": 4, "scale": 2}, "scale: "),
        ({"kind": "leave", "robot": 4, "dance": 1}, "dance: "),
        ({"kind": "resume", "seen_s": "now"}, "seen_s: "),
        ({"kind": "leave", "robot": 4, "seen_s": None}, "seen_s: "),
        ({"kind": "leave", "robot": 4, "seen_s": 1.0}, "too long ago"),
        ({"kind": "leave", "robot": 7}, "cannot be done: "),
    ],
)
def test_what_is_wrong_with_an_order_is_told_in_one_line(
    made: Made, content: dict[str, Any], why: str
) -> None:
    made.take({"id": "a", **content})
    (line,) = made.of("a")["lines"]
    assert why in line
    assert made.of("a")["over"]
    assert made.running.bus.said == []


def test_a_resume_that_waited_on_its_way_lifts_no_stop_that_was_given_since(made: Made) -> None:
    """As in the buffer of a server that stood, or of a tunnel."""
    order = {"id": "a", "kind": "resume", "seen_s": made.running.clock.ns / S}
    made.step(S)
    stopped(made.running, 0)
    made.step(S)
    made.controls.take(order)
    assert "somebody has just said stop" in made.of("a")["lines"][0]
    made.step(3 * S)
    made.controls.take(order | {"id": "b"})
    assert "too long ago" in made.of("b")["lines"][0]
    assert made.running.of(Resume) == []


def test_a_stop_is_given_whatever_else_is_said_with_it(made: Made) -> None:
    mores: list[dict[str, Any]] = [
        {"reason": 5},
        {"reason": None},
        {"reason": ["x"]},
        {"robot": 99},
        {"seen_s": "x"},
        {"seen_s": 1.0},
        {"more": {}},
    ]
    for number, more in enumerate(mores):
        made.take({"id": str(number), "kind": "stop", **more})
        assert len({each.version for each in made.running.of(Stop)}) == number + 1
    made.take({"id": "long", "kind": "stop", "reason": "x" * 5_000})
    assert len(made.of("long")["what"]) <= REASON_MAX + len("stop: ")


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(2**63), 0, 1, 4, 7])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["1", "4", "7", "\ud800", "1->2", "100%", "2s"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=8,
)
FIELDS = (
    "robot",
    "robots",
    "edges",
    "by",
    "scale",
    "formation",
    "over_s",
    "offset_m",
    "reason",
    "at",
    "seen_s",
)
KINDS = ("stop", "resume", "join", "leave", "replace", "remove", "reshape")


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(KINDS), st.dictionaries(st.sampled_from(FIELDS), VALUES, max_size=4))
def test_whatever_a_page_says_is_given_or_refused(made: Made, kind: str, fields: dict[str, Any]) -> None:
    made.running.bus.said.clear()
    made.take({"id": "a", "kind": kind, **fields})
    about = made.of("a")
    if "count" not in about:  # refused
        assert about["over"]
        assert len(about["lines"]) == 1
        assert made.running.bus.said == []
    else:
        assert made.running.bus.said
    made.controls._given.clear()


# ---------------------------------------------------------------------- questions


class Ask(Protocol):
    def __call__(self, content: Mapping[str, Any]) -> dict[str, Any]: ...
