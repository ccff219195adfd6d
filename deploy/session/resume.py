"""Sends a resume to a running fleet, and waits for what becomes of it."""

from __future__ import annotations

from collections.abc import Sequence

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.orders.operator import Known, is_since
from handfast.deploy.orders.resume_outcome import Resuming
from handfast.deploy.session.operator_session import OperatorSession
from handfast.deploy.session.session import ANSWER_S, INBOX, connected


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
