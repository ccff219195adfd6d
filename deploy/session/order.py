"""Sessions that give an order or a resume to a running fleet, and wait for what becomes of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message, Mission
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.orders.mission_editing import must_be_known
from handfast.deploy.orders.mission_outcome import Ordering, Resuming
from handfast.deploy.orders.operator import HEARD_NS, NO_MISSION, Known, is_since
from handfast.deploy.session.operator_session import OperatorSession
from handfast.deploy.session.session import ANSWER_S, INBOX, connected

TAKE_S: Final = 3.0
"""Agents that have not acknowledged a mission by then are named."""
CONFIRM_S: Final = 1.0
"""Agents do not say the same again within half a second."""


class OrderSession(OperatorSession):
    """A session that changes the mission.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    _answers = 0

    def feed(self, key: str, message: Message) -> None:
        super().feed(key, message)
        self._answers += type(message) is Mission

    def order(self, make: Callable[[Plan], OrderSection]) -> tuple[Mission, Ordering]:
        """Gives the order that `make` makes of what the fleet does now; waits until all have acknowledged it.

        Raises:
            NoAnswerError: the fleet has no mission yet; or no robot would believe this machine's clock.
            handfast.deploy.orders.mission_editing.OrderError: the order cannot be carried out.
        """
        self.ask()
        operator = self.operator
        if trouble := operator.clock_trouble(self.now_ns()):
            raise NoAnswerError(f"not given: {trouble}")
        if operator.plan is None:
            raise NoAnswerError(NO_MISSION)
        order = make(operator.plan)
        mission = operator.give(order, self.now_ns(), self._listened(must_be_known(order, operator.plan)))
        assert type(mission) is Mission
        ordering = Ordering(mission, self.fleet.ids)

        def look() -> bool:
            return ordering.look(self.agents, self.statuses, operator.mission)

        def say() -> None:
            if operator.mission is not None:  # the newest, whoever has made it
                self.say(operator.mission)

        self.until(look, say, TAKE_S)
        if not ordering.overruled:
            # Another operator's of the same version shows only in what the agents say it is.
            self._answers = 0
            self.until(lambda: self._answers > 0, self.say_ask, CONFIRM_S)
            look()
        return mission, ordering

    def _listened(self, robots: Collection[int]) -> set[int]:
        """Who is heard, after it was listened to these robots for long enough, if there are any."""
        if robots:
            self.listen_to_beacons()
            self.wait(lambda: not self.heard.isdisjoint(robots), HEARD_NS / NS_PER_S)
        return self.heard


class ResumeSession(OperatorSession):
    """A session that hears whether robots drive.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._resuming: Resuming | None = None
        self.bus.subscribe(key_expressions.plant_state(fleet.fleet.name, "*"), INBOX)

    def feed(self, key: str, message: Message) -> None:
        super().feed(key, message)
        if self._resuming is not None:
            self._resuming.feed(key, message)

    def resume(self, robots: Sequence[int], given_ns: int) -> Resuming:
        """Lets these robots drive again, or all when none is named. Waits until they do, but not for ever.

        Args:
            given_ns: when somebody gave the resume (wall clock).

        Raises:
            NoAnswerError: somebody has said stop after this was given: that is not what it is to lift; or no
                robot would believe this machine's clock.
        """
        self.ask()  # a resume must be later than the stop that it ends
        if trouble := self.operator.clock_trouble(self.now_ns()):
            raise NoAnswerError(f"nobody is resumed: {trouble}")
        stop = self.operator.stop_in_force
        if stop is not None and is_since(stop, given_ns, self.now_ns()):
            what = f": {printable(stop.reason)}" if stop.reason else ""
            raise NoAnswerError(
                f"nobody is resumed: somebody has just said stop{what}; resume again to lift that"
            )
        message = self.operator.order_resume(self.now_ns(), robots, given_ns)
        resuming = Resuming(self.fleet, message, self.statuses)
        self._resuming = resuming
        # It is sent again until all have done it: a link may lose a message.
        self.until(lambda: resuming.done, lambda: self.say(resuming.message), ANSWER_S)
        return resuming


def resume(fleet: Fleet, robots: Sequence[int], given_ns: int) -> tuple[Resuming, Known]:
    """What became of a resume of these robots of a running fleet, none: all; and what is ordered then.

    Args:
        given_ns: see `ResumeSession.resume`.

    Raises:
        handfast.deploy.inventory.known_fleets.NoAnswerError: nobody is there.
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """
    with connected(ResumeSession(fleet)) as session:
        return session.resume(robots, given_ns), session.operator
