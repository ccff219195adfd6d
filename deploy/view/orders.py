"""Orders of pages that are on their way: each is given, said again, and followed until all have done it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import ScenarioError, read_orders
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.messages.types import Ask, Message, Mission, Stop
from handfast.deploy.console.wording import FEW
from handfast.deploy.drive.fleet_state import FleetState
from handfast.deploy.drive.preconditions import somebodys
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.mission_outcome import Ordering, Resuming, words
from handfast.deploy.orders.operator import NO_MISSION, is_since
from handfast.deploy.orders.stop_outcome import Stopping, again_s
from handfast.deploy.session.operator_session import SEND_PERIOD_S
from handfast.deploy.session.order import CONFIRM_S, TAKE_S
from handfast.deploy.session.session import ANSWER_S
from handfast.deploy.session.stop import WAIT_S, OtherWays, Way

SEEN: Final = "seen_s"
"""The field of an order that says when the frame was made (s, this wall clock) which its page showed then."""
SEEN_S_MAX: Final = 3.0
"""Only a stop is given by what a page showed longer ago."""


class RefusedError(ValueError):
    """An order that is not given; the text is one sentence that says why."""


class UnderWay(Protocol):
    """An order that was given."""

    @property
    def what(self) -> str:
        """What was ordered, in words."""
        ...

    @property
    def done(self) -> bool:
        """Whether all have done it."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether nothing more is done for it."""
        ...

    @property
    def count(self) -> tuple[int, int]:
        """How many have done it, of how many."""
        ...

    def lines(self) -> list[str]:
        """What became of it until now."""
        ...

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes a message that came after it."""
        ...

    def step(self, now_ns: int) -> None:
        """Does what is due."""
        ...


def _seconds(since_ns: int, now_ns: int) -> float:
    return (now_ns - since_ns) / NS_PER_S


class StopUnderWay:
    """A stop, by every way there is, as `deploy.session.stop.stop` gives it.

    Args:
        ways: besides the links that there are; they are closed in the end.
    """

    def __init__(self, state: FleetState, reason: str, ways: Sequence[Way]) -> None:
        self._state, self._ways = state, ways
        self._begun_ns = now_ns = state.clock.now_ns()
        self._stopping: Final = Stopping(state.fleet, now_ns, somebodys(reason))
        self._stopping.outdo(state.operator.order_version)
        self._others: Final = OtherWays(ways, self._stopping)
        self._again_ns: Final = round(again_s(state.fleet) * NS_PER_S)
        self._said: Stop | None = None
        self._due_ns = 0
        self.is_over = False
        self.what: Final = "stop" + (f": {reason}" if reason else "")
        self.step(now_ns)

    @property
    def done(self) -> bool:
        return self._stopping.done

    @property
    def count(self) -> tuple[int, int]:
        ids = self._state.fleet.ids
        return sum(map(self._stopping.stands_by, ids)), len(ids)

    def lines(self) -> list[str]:
        troubles = [] if self.done else [printable(text) for way in self._ways for text in way.troubles]
        return [*self._stopping.outcomes(each=len(self._state.fleet.ids) <= FEW), *troubles]

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        self._stopping.feed(now_ns, key, message)

    def step(self, now_ns: int) -> None:
        stopping, state = self._stopping, self._state
        if stopping.message is not self._said or now_ns >= self._due_ns:
            self._said, self._due_ns = stopping.message, now_ns + self._again_ns
            state.operator.hear(state.operator.keys[Stop], stopping.message)
            state.say(stopping.message)
        self._others.send()
        self._others.collect()
        waited_s = _seconds(self._begun_ns, now_ns)
        more = waited_s < ANSWER_S or (waited_s < WAIT_S and (stopping.is_being_kept or self._others.busy))
        if stopping.settled or not more:
            self.is_over = True
            for way in self._ways:
                way.close()


class ResumeUnderWay:
    """A resume of some robots, none: of all.

    Args:
        given_ns: when somebody gave it (wall clock): it lifts no stop that was given since.

    Raises:
        RefusedError: no robot would believe this machine's clock, or somebody has just said stop.
    """

    def __init__(self, state: FleetState, robots: Sequence[int], given_ns: int) -> None:
        self._state = state
        self._begun_ns = now_ns = state.clock.now_ns()
        operator = state.operator
        if trouble := operator.clock_trouble(now_ns):
            raise RefusedError(f"nobody is resumed: {trouble}")
        stop = operator.stop_in_force
        if stop is not None and is_since(stop, given_ns, now_ns):
            raise RefusedError("nobody is resumed: somebody has just said stop; resume again to lift that")
        message = operator.order_resume(now_ns, robots, given_ns)
        self._resuming: Final = Resuming(state.fleet, message, state.watch.statuses)
        self._due_ns = 0
        self.is_over = False
        self.what: Final = "resume" + (f" {', '.join(map(str, robots))}" if robots else "")
        self.step(now_ns)

    @property
    def done(self) -> bool:
        return self._resuming.done

    @property
    def count(self) -> tuple[int, int]:
        return sum(map(self._resuming.runs, self._resuming.robots)), len(self._resuming.robots)

    def lines(self) -> list[str]:
        return self._resuming.outcomes

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        self._resuming.feed(key, message)

    def step(self, now_ns: int) -> None:
        if self.done or _seconds(self._begun_ns, now_ns) >= ANSWER_S:
            self.is_over = True
        elif now_ns >= self._due_ns:
            self._due_ns = now_ns + round(SEND_PERIOD_S * NS_PER_S)
            self._state.say(self._resuming.message)


class ChangeUnderWay:
    """A change of the mission: who has a place, and what the formation is.

    Raises:
        RefusedError: it cannot be carried out, or no robot would believe this machine's clock.
    """

    def __init__(self, state: FleetState, order: OrderSection) -> None:
        self._state = state
        self._begun_ns = now_ns = state.clock.now_ns()
        operator = state.operator
        if trouble := operator.clock_trouble(now_ns):
            raise RefusedError(f"not given: {trouble}")
        if operator.plan is None:
            raise RefusedError(NO_MISSION)
        try:
            mission = operator.give(order, now_ns, state.heard)
        except OrderError as error:
            raise RefusedError(f"cannot be done: {error}") from None
        assert type(mission) is Mission
        self._mission: Final = mission
        self._ordering: Final = Ordering(mission, state.fleet.ids)
        self._due_ns = 0
        self._confirm_ns: int | None = None
        self._is_confirmed = False
        self.is_over = False
        self.what: Final = words(mission)
        self.step(now_ns)

    @property
    def done(self) -> bool:
        return self.is_over and self._ordering.done

    @property
    def count(self) -> tuple[int, int]:
        ids = self._state.fleet.ids
        return sum(map(self._ordering.has_acknowledged, ids)), len(ids)

    def lines(self) -> list[str]:
        return self._ordering.outcomes()

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        # Another operator's of the same version shows only in what the agents say it is.
        self._is_confirmed |= type(message) is Mission and self._confirm_ns is not None

    def step(self, now_ns: int) -> None:
        state, operator = self._state, self._state.operator
        agents = [robot for robot in state.fleet.ids if (robot, "agent") in state.present]
        is_told = self._ordering.look(agents, state.watch.statuses, operator.mission)
        if self._confirm_ns is None and (is_told or _seconds(self._begun_ns, now_ns) >= TAKE_S):
            self._confirm_ns = now_ns
            self._due_ns = 0
        if self._confirm_ns is not None and (
            self._is_confirmed or self._ordering.overruled or _seconds(self._confirm_ns, now_ns) >= CONFIRM_S
        ):
            self.is_over = True
        elif now_ns >= self._due_ns:
            self._due_ns = now_ns + round(SEND_PERIOD_S * NS_PER_S)
            if self._confirm_ns is not None:
                state.say(Ask(now_ns, state.author))
            elif operator.mission is not None:  # the newest, whoever has made it
                state.say(operator.mission)


def given_ns(content: Mapping[str, Any], now_ns: int) -> int:
    """When a page's order was given, by this clock (ns): it tells when the frame was made that it showed then
    (`SEEN`), however long it has been on its way since.

    Raises:
        RefusedError: it does not tell, or that was too long ago: what is wanted now may be another thing.
    """
    seen_s = content.get(SEEN)
    if not isinstance(seen_s, float):
        raise RefusedError(f"{SEEN}: not when the frame was made that the page showed, in s")
    age_s = now_ns / NS_PER_S - seen_s
    if not abs(age_s) <= SEEN_S_MAX:  # not so for NaN
        raise RefusedError("given by what the page showed too long ago; look, and order again")
    return min(now_ns, round(seen_s * NS_PER_S))


def order_of(content: Mapping[str, Any], ids: Sequence[int]) -> OrderSection:
    """The order that a page gives, with the fields of an ``[[order]]`` of a fleet file.

    Raises:
        RefusedError: it is none.
    """
    fields = {key: value for key, value in content.items() if key != SEEN}
    try:
        return read_orders({"order": [{"at": 0.0, **fields}]}, ids)[0]
    except ScenarioError as error:
        said = (f"{each.place.removeprefix('order[1].')}: {each.message}" for each in error.problems)
        raise RefusedError("; ".join(said)) from None
