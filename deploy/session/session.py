"""An operator's session with a fleet that is running: who is there, and what they say."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, TypeVar

from handfast.agent.common.closing import Closing
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.loop import RealClock
from handfast.agent.transport.bus import Bus
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.faults.live import Receiver, receivers
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.session.operator_bus import operator_bus

CONNECT_S: Final = 3.0
"""Processes that are not there by then are named and left out."""
POLL_S: Final = 0.02
ANSWER_S: Final = 3.0
"""So long robots have to answer an order."""
INBOX: Final = 4096
"""Messages that may wait to be read, of one key."""


def valid(payload: bytes) -> Message | None:
    """The message in `payload`, None when it is not one."""
    try:
        return decode(payload)
    except Malformed:
        return None


def always() -> bool:
    """Until Ctrl-C, which Zenoh would leave unanswered for seconds while no router answers."""
    return True


class Session(Closing):
    """An operator on the bus of `fleet`, connected to every agent and plant. A context manager.

    Args:
        bus: `operator_bus` of the fleet, unless it is another one.
        is_wanted: as of an `operator_bus`.

    Attributes:
        bus: what those that build on this subscribe to and publish on.
        receivers: every agent and plant.
        alive: those that are there.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet, bus: Bus | None = None, is_wanted: Callable[[], bool] = always) -> None:
        self.fleet: Final = fleet
        self.receivers: Final = receivers(fleet)
        self.clock: Final = RealClock()
        self.alive: set[Receiver] = set()
        self.bus: Final = operator_bus(fleet, is_wanted=is_wanted) if bus is None else bus
        self._presence = self.bus.watch(key_expressions.alive(fleet.fleet.name, "*", "*"))

    def close(self) -> None:
        self.bus.close()

    def now_ns(self) -> int:
        return self.clock.now_ns()

    def feed(self, key: str, message: Message) -> None:
        """Takes a valid message that came on `key`."""

    def gone(self, receiver: Receiver) -> None:
        """Called for a process that is not there any more."""

    def collect(self) -> None:
        """Takes what came."""
        known = set(self.receivers)
        for key, here in self._presence.update():
            receiver = key_expressions.robot_of_alive(key)
            if receiver in known:
                if here:
                    self.alive.add(receiver)
                else:
                    self.alive.discard(receiver)
                    self.gone(receiver)
        for key, payload in self.bus.drain():
            message = valid(payload)
            if message is not None:
                self.feed(key, message)

    def wait(self, look: Callable[[], bool], timeout_s: float) -> bool:
        """Collects until `look` says True; False when it has not within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while True:
            self.collect()
            if look():
                return True
            if time.monotonic() >= deadline:
                return False
            self.pause()

    def no_answer(self) -> NoAnswerError:
        """What to raise when nobody is there."""
        fleet = self.fleet
        return NoAnswerError(
            f"fleet {fleet.fleet.name} does not answer: none of its {len(self.receivers)} agents and "
            f"plants is there ({fleet.agent_endpoint(fleet.ids[0])} and so on); is it running?"
        )

    def pause(self) -> None:
        """A moment's wait, until something may have come."""
        time.sleep(POLL_S)


S = TypeVar("S", bound=Session)


def connected(session: S, interrupt: Interrupt | None = None) -> S:
    """`session` when all processes of its fleet are there, or as many as came.

    Raises:
        NoAnswerError: there is none; the session is closed.
    """
    try:
        everybody = session.wait(
            lambda: (
                len(session.alive) == len(session.receivers)
                or (interrupt is not None and interrupt.count > 0)
            ),
            CONNECT_S,
        )
        if not everybody and not session.alive:
            raise session.no_answer()
    except BaseException:
        session.close()
        raise
    return session
