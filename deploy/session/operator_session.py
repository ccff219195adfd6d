"""A session with a fleet that is running, of an operator who has heard what was ordered last."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Ask, Beacon, Heartbeat, Message, Mission, Resume, Status, Stop
from handfast.deploy.analysis.silence import SilentBodies
from handfast.deploy.console.wording import robots
from handfast.deploy.inventory.own_orders import OwnOrders
from handfast.deploy.orders.operator import Operator, Order
from handfast.deploy.session.faults import author
from handfast.deploy.session.session import INBOX, Session, always

ASK_S: Final = 1.0
SEND_PERIOD_S: Final = 0.25


class OperatorSession(Session):
    """A session that hears and gives orders.

    Args:
        is_wanted: as of an `operator_bus`.

    Attributes:
        operator: what has been ordered, and gives orders.
        own: what is known of that on this machine.
        statuses: what each agent said last.
        silent: robots that are not heard, once `listen_to_beacons` was called.
        heard: robots whose agents have said something.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet, is_wanted: Callable[[], bool] = always) -> None:
        fleet = resolved(fleet)  # as agents read it: missions are for this file and no other
        super().__init__(fleet, is_wanted=is_wanted)
        name = fleet.fleet.name
        self.operator: Final = Operator(fleet, resolve(fleet))
        self.statuses: dict[int, Status] = {}
        self.silent: Final = SilentBodies()
        self.heard: Final[set[int]] = set()
        self.author: Final = author()
        self.own: Final = OwnOrders(fleet)
        for order in self.own.orders:
            self.operator.hear(self.operator.keys[type(order)], order)
        for key in self.operator.keys.values():
            self.bus.declare(key)
        orders = (key_expressions.mission(name), key_expressions.stop(name), key_expressions.resume(name))
        for key in (key_expressions.status(name, "*"), key_expressions.relayed(name, "*"), *orders):
            self.bus.subscribe(key, INBOX)

    def __exit__(self, *error: object) -> None:
        self.own.warn()
        super().__exit__(*error)

    def feed(self, key: str, message: Message) -> None:
        if (order := self.operator.hear_at(self.now_ns(), key, message)) is not None:
            self.own.keep(order)
        if type(message) is Status and key == key_expressions.status(self.fleet.fleet.name, message.robot):
            self.statuses[message.robot] = message
            self.heard.add(message.robot)
        elif type(message) is Beacon and key == key_expressions.beacon(self.fleet.fleet.name, message.robot):
            self.silent.hear(message)
            self.heard.add(message.robot)

    def listen_to_beacons(self) -> None:
        """From now on `silent` is told which robots are not heard."""
        self.bus.subscribe(key_expressions.beacon(self.fleet.fleet.name, "*"), INBOX)

    @property
    def agents(self) -> list[int]:
        """The robots whose agents are there."""
        return [robot for robot in self.fleet.ids if (robot, "agent") in self.alive]

    def say(self, message: Order | Heartbeat | Ask) -> None:
        self.bus.publish(*self.operator.outgoing(message))
        if isinstance(message, Mission | Stop | Resume):
            self.own.keep(message)

    def ask(self) -> None:
        """Asks the fleet for its last orders; waits until all was heard that its agents have acknowledged."""
        self.say_ask()
        self.until(self._informed, self._ask_again, ASK_S)
        self._remind()

    def _ask_again(self) -> None:
        """An answer costs all robots of the fleet: it is asked again only where one is missing."""
        if self.operator.behind:
            self.say_ask()

    def _remind(self) -> None:
        """Says a stop again that is known here and in force, and that robots do not know: all who had kept it
        may be gone."""
        stop = self.operator.stop_in_force
        if stop is None or not (lacking := self._without(stop)):
            return
        self.until(lambda: not self._without(stop), lambda: self.say(stop), ASK_S)
        at, why = time.strftime("%H:%M:%S", time.localtime(stop.time_ns / 1e9)), printable(stop.reason)
        print(
            f"handfast: {robots(lacking)} did not know of the stop that was given at {at}"
            f"{f': {why}' if why else ''}; told again",
            file=sys.stderr,
        )

    def _without(self, stop: Stop) -> list[int]:
        return self.operator.without(stop, [robot for robot in self.agents if robot in self.statuses])

    def say_ask(self) -> None:
        self.say(Ask(self.now_ns(), self.author))

    def _informed(self) -> bool:
        return not self.operator.behind and all(robot in self.statuses for robot in self.agents)

    def until(self, look: Callable[[], bool], say: Callable[[], None], timeout_s: float) -> bool:
        """Says something now and then until `look` says True; False when it has not within `timeout_s`."""
        for _ in range(round(timeout_s / SEND_PERIOD_S)):
            say()
            if self.wait(look, SEND_PERIOD_S):
                return True
        return False
