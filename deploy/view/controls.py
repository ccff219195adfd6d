"""What pages order of a running fleet, and what becomes of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from handfast.agent.messages.types import Message
from handfast.deploy.drive.fleet_state import FleetState
from handfast.deploy.session.stop import Way
from handfast.deploy.view.moves import judged, order_to_move
from handfast.deploy.view.orders import (
    ChangeUnderWay,
    RefusedError,
    ResumeUnderWay,
    StopUnderWay,
    UnderWay,
    given_ns,
    order_of,
)

SHOWN_MAX: Final = 12
"""So many of the last orders are told to pages, with what became of them."""
KNOWN_MAX: Final = 500
"""So many that are over are known by their names, so that one that is said again is not done again."""
ID_MAX: Final = 64
LINES_MAX: Final = 12
REASON_MAX: Final = 200

Make = Callable[[Mapping[str, Any]], UnderWay]
"""Gives an order of a page; raises RefusedError where it cannot be."""


class _Given:
    """An order as it was given, or why it was not."""

    def __init__(self, name: str, kind: str) -> None:
        self.name, self.kind = name, kind
        self.under_way: UnderWay | None = None
        self.refused = ""
        self._last: dict[str, Any] | None = None

    @property
    def is_told(self) -> bool:
        """Whether it was told how it ended."""
        return self._last is not None

    def content(self) -> dict[str, Any]:
        """As JSON values. What became of one that is over does not change by what comes later."""
        if self._last is not None:
            return self._last
        content = self._now()
        self._last = content if content["over"] else None
        return content

    def _now(self) -> dict[str, Any]:
        known = {"id": self.name, "kind": self.kind}
        if self.under_way is None:
            return known | {"what": self.kind, "over": True, "done": False, "lines": [self.refused]}
        lines = self.under_way.lines()
        more = len(lines) - LINES_MAX
        return known | {
            "what": self.under_way.what,
            "over": self.under_way.is_over,
            "done": self.under_way.done,
            "count": list(self.under_way.count),
            "lines": [*lines[:LINES_MAX], *([f"and {more} more"] if more > 0 else [])],
        }


class Controls:
    """Takes orders of pages. One that is said again, as over a link that was lost, is not given again.

    Args:
        state: through which they go.
        ways: makes the ways of a stop besides the links that there are.
        told: is told what became of the last orders, as JSON values.
    """

    def __init__(
        self, state: FleetState, ways: Callable[[], Sequence[Way]], told: Callable[[list[Any]], None]
    ) -> None:
        self._state, self._told = state, told
        self.kinds: Final[dict[str, Make]] = {
            "stop": lambda content: StopUnderWay(state, _reason(content), ways()),
            "resume": lambda content: ResumeUnderWay(
                state,
                order_of(content, state.fleet.ids).robots or (),
                given_ns(content, state.clock.now_ns()),
            ),
        }
        """By kind, what gives an order."""
        for kind in ("join", "leave", "replace", "remove", "reshape"):
            self.kinds[kind] = lambda content: ChangeUnderWay(state, order_of(content, state.fleet.ids))
        self._given: dict[str, _Given] = {}

    def take(self, content: Mapping[str, Any]) -> None:
        """Takes an order: `id`, by which it is known, `kind`, the fields of its kind, and unless it is a stop
        `seen_s`, by which it is known when it was given (`deploy.view.orders.given_ns`)."""
        name, kind = content.get("id"), content.get("kind")
        if not isinstance(name, str) or not 0 < len(name) <= ID_MAX:
            return
        if name in self._given:
            self._tell_again(name)
            return
        given = self._given[name] = _Given(name, str(kind)[:ID_MAX])
        make = self.kinds.get(kind) if isinstance(kind, str) else None
        fields = {key: value for key, value in content.items() if key != "id"}
        try:
            if make is None:
                raise RefusedError(f"nothing that can be ordered here; there are {', '.join(self.kinds)}")
            if kind != "stop":
                given_ns(fields, self._state.clock.now_ns())
            given.under_way = make(fields)
        except RefusedError as error:
            given.refused = str(error)
        self._tell()
        over = [known for known, each in self._given.items() if each.is_told]
        for known in over[: max(0, len(over) - KNOWN_MAX)]:
            del self._given[known]

    def _tell_again(self, name: str) -> None:
        """Who says an order again has not been told of it: if others came since, it is told with the last."""
        if name not in [*self._given][-SHOWN_MAX:]:
            self._given[name] = self._given.pop(name)
            self._tell()

    async def preview(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """What would come of a formation whose places are dragged (`deploy.view.moves`): the `number` of the
        question, what is to be said, and whether it may be ordered."""
        number, state = content.get("number"), self._state
        plan = state.operator.plan
        try:
            order = order_to_move(content, plan, state.fleet)
            assert plan is not None
            text, fine = await asyncio.to_thread(judged, order, plan, state.fleet, state.clock.now_ns())
        except RefusedError as error:
            text, fine = str(error), False
        return {"number": number if isinstance(number, int) else 0, "text": text, "fine": fine}

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes a message that came."""
        for each in self._under_way():
            each.feed(now_ns, key, message)

    def step(self) -> None:
        """Does what is due, and tells what came of it."""
        under_way = self._under_way()
        if not under_way:
            return
        now_ns = self._state.clock.now_ns()
        for each in under_way:
            if not each.is_over:
                each.step(now_ns)
        self._tell()

    def _under_way(self) -> list[UnderWay]:
        """Those that are not over, or of which the end is still to be told."""
        return [
            given.under_way
            for given in self._given.values()
            if given.under_way is not None and not given.is_told
        ]

    def _tell(self) -> None:
        told = [given.content() for given in self._given.values()]
        self._told(told[-SHOWN_MAX:])


def _reason(content: Mapping[str, Any]) -> str:
    reason = content.get("reason", "")
    return reason[:REASON_MAX] if isinstance(reason, str) else ""
