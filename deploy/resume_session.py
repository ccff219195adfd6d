"""Sends leave to drive again to a running fleet, and waits for what becomes of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from agent import keys
from agent.fleet import Fleet
from agent.messages import Message, encode
from deploy.resuming import Resuming
from deploy.session import Session, connected

ANSWER_S: Final = 3.0
SEND_PERIOD_S: Final = 0.5
"""It is said again until all have done it: a link may lose a message."""


class ResumeSession(Session):
    """A session that hears whether robots drive.

    Raises:
        agent.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet) -> None:
        super().__init__(fleet)
        self._name = fleet.fleet.name
        self._resuming: Resuming | None = None
        self.bus.declare(keys.resume(self._name))
        for key in (keys.status(self._name, "*"), keys.plant_state(self._name, "*")):
            self.bus.subscribe(key)

    def feed(self, key: str, message: Message) -> None:
        if self._resuming is not None:
            self._resuming.feed(key, message)

    def resume(self, robots: Sequence[int]) -> Resuming:
        """Lets these robots drive again, or all when none is named. Waits until they do, but not for ever."""
        self.collect()  # what was said before is no answer
        resuming = self._resuming = Resuming(self.fleet, robots, self.now_ns())
        begun = time.monotonic()
        while not resuming.done and time.monotonic() < begun + ANSWER_S:
            self.bus.publish(keys.resume(self._name), encode(resuming.message))
            self.wait(lambda: resuming.done, SEND_PERIOD_S)
        return resuming


def resume(fleet: Fleet, robots: Sequence[int]) -> Resuming:
    """What became of leave for these robots of a running fleet, none: all.

    Raises:
        deploy.running.NoAnswerError: nobody is there.
        agent.bus.BusError: the bus cannot be opened.
    """
    with connected(ResumeSession(fleet)) as session:
        return session.resume(robots)
