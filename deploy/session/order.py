"""Gives an order to a running fleet, and waits for what becomes of it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.mission_plan import Plan
from handfast.agent.messages.types import Message, Mission
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.orders.mission_editing import must_be_known
from handfast.deploy.orders.mission_outcome import Ordering
from handfast.deploy.orders.operator import HEARD_NS, NO_MISSION
from handfast.deploy.session.operator_session import OperatorSession

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
