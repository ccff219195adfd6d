"""Sends a stop to a running fleet, to each of its processes as soon as it can be reached."""

from __future__ import annotations

import time
from typing import Final

from agent.fleet.model import Fleet
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.types import Message
from deploy.orders.stop_outcome import Stopping
from deploy.session.session import ANSWER_S, INBOX, Session

SEND_PERIOD_S: Final = 0.05


class StopSession(Session):
    """A session that hears who brakes.

    Raises:
        agent.runtime.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet, reason: str) -> None:
        super().__init__(fleet)
        name = fleet.fleet.name
        self._key = key_expressions.stop(name)
        self.bus.declare(self._key)
        self._stopping = Stopping(fleet, self.now_ns(), reason)
        self._sent_to, self._sent = 0, self._stopping.message
        # Before all else: what is connected already must not wait for the rest.
        self._send()
        for key in (key_expressions.status(name, "*"), key_expressions.plant_state(name, "*")):
            self.bus.subscribe(key, INBOX)

    def feed(self, key: str, message: Message) -> None:
        self._stopping.feed(self.now_ns(), key, message)

    def _send(self) -> None:
        self.bus.publish(self._key, encode(self._stopping.message))

    @property
    def _send_at_once(self) -> bool:
        """Whether a process has come since the stop was sent last, or the stop got a greater version."""
        return len(self.alive) > self._sent_to or self._stopping.message is not self._sent

    def stop(self) -> Stopping:
        """Sends the stop again, at once to every process that comes, until all brake; gives up after a while.

        Raises:
            deploy.inventory.running.NoAnswerError: nobody is there.
        """
        stopping, deadline = self._stopping, time.monotonic() + ANSWER_S
        while not stopping.done and time.monotonic() < deadline:
            self._sent_to, self._sent = len(self.alive), stopping.message
            self.wait(lambda: stopping.done or self._send_at_once, SEND_PERIOD_S)
            self._send()
        if not self.alive:
            raise self.no_answer()
        return stopping


def stop(fleet: Fleet, reason: str) -> Stopping:
    """What became of a stop of a running fleet; raises as `StopSession` and `StopSession.stop`."""
    with StopSession(fleet, reason) as session:
        return session.stop()
