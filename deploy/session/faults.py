"""An operator's session with a running fleet: sends live fault rules, and hears who holds them."""

from __future__ import annotations

from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import Faults, Message, PlantState
from handfast.deploy.faults.live import Held, Receiver
from handfast.deploy.session.author import author
from handfast.deploy.session.session import INBOX, Session


class FaultsSession(Session):
    """A session that sends and hears of live fault rules.

    Attributes:
        held: what the receivers say that they hold.
        epoch_ns: the mission's, as the plants' messages tell it; None until one has.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        name = fleet.fleet.name
        self.author: Final = author()
        self.held = Held(fleet)
        self.epoch_ns: int | None = None
        self._version = 0
        self._key = key_expressions.faults(name)
        self.bus.declare(self._key)
        for role in key_expressions.ROLES:
            self.bus.subscribe(key_expressions.faults_held(name, "*", role), INBOX)
        self.bus.subscribe(key_expressions.plant_state(name, "*"))

    def version(self) -> int:
        """The next version of this operator's messages: grows from message to message, and from author to
        author as long as their clocks are right."""
        newest = max((each.message.version for each in self.held.sets(self.now_ns())), default=0)
        self._version = max(self._version + 1, newest + 1, self.now_ns() // 1_000_000)
        return self._version

    def send(self, message: Faults) -> None:
        self.bus.publish(self._key, encode(message))

    def gone(self, receiver: Receiver) -> None:
        self.held.forget(receiver)

    def feed(self, key: str, message: Message) -> None:
        if type(message) is Faults:
            self.held.feed(key, message)
        elif type(message) is PlantState and message.sequence >= FIRST_ROUND:
            rounds = message.sequence - FIRST_ROUND
            self.epoch_ns = message.time_ns - rounds * self.fleet.period_ns
