"""An operator's heartbeat to a running fleet."""

from __future__ import annotations

from typing import Final, TextIO

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Heartbeat
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import robots
from handfast.deploy.orders.operator import HEARTBEAT_PERIOD_NS
from handfast.deploy.session.faults import Line, author
from handfast.deploy.session.session import Session, connected

PERIOD_S: Final = HEARTBEAT_PERIOD_NS / 1e9


class HeartbeatSession(Session):
    """A session that sends heartbeats.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._author = author()
        self._key = key_expressions.heartbeat(fleet.fleet.name)
        self.bus.declare(self._key)

    def beat(self, interrupt: Interrupt, stream: TextIO) -> None:
        """Sends them until interrupted, and says on `stream` who is there to hear them."""
        line = Line(stream)
        while not interrupt.count:
            self.bus.publish(self._key, encode(Heartbeat(self.now_ns(), self._author)))
            heard = hearers(self.fleet, {robot for robot, role in self.alive if role == "agent"})
            line.show(heard, heard)
            self.wait(lambda: interrupt.count > 0, PERIOD_S)
        line.end()


def hearers(fleet: Fleet, agents: set[int]) -> str:
    """Who hears the heartbeats, in words."""
    absent = [robot for robot in fleet.ids if robot not in agents]
    text = f"heartbeats heard by {len(agents)} of {len(fleet.ids)} agents"
    return f"{text}; not by {robots(absent)}" if absent else text


def beat(fleet: Fleet, interrupt: Interrupt, stream: TextIO) -> None:
    """Sends heartbeats to a running fleet until interrupted.

    Raises:
        handfast.deploy.inventory.known_fleets.NoAnswerError: nobody is there.
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """
    with connected(HeartbeatSession(fleet), interrupt) as session:
        session.beat(interrupt, stream)
