"""Stops a running fleet by every way that there is, side by side: the first that works wins.

The channels are new links, as an operator's session has them, and a file on the robots' computer, written
here (`stop_by_file`) or over ssh (`deploy.hosts.stop_by_ssh`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Final, Protocol

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Message, Mission, Stop
from handfast.agent.transport.bus import BusError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.own_orders import OwnOrders
from handfast.deploy.orders.stop_outcome import AGAIN_S, Stopping, again_s
from handfast.deploy.session.operator_bus import operator_bus
from handfast.deploy.session.session import ANSWER_S, INBOX, Session

WAIT_S: Final = 10.0
"""What is slow is waited for so long: a way such as ssh to a host that is far away, and who brakes but has
not kept the stop yet, on a machine that has too much to do."""


class Way(Protocol):
    """One way by which a stop reaches robots."""

    def send(self, stop: Stop) -> None:
        """Sends it; waits for nothing, and raises nothing."""
        ...

    def collect(self, stopping: Stopping) -> None:
        """Tells what has come back until now."""
        ...

    @property
    def busy(self) -> bool:
        """Whether something may still come back."""
        ...

    @property
    def troubles(self) -> Sequence[str]:
        """What did not work, a line each."""
        ...

    def close(self) -> None:
        """Ends what is under way."""
        ...


class StopSession(Session):
    """The way over new links: to each of the fleet's processes as soon as it can be reached.

    Args:
        is_wanted: as of an `operator_bus`.

    Raises:
        handfast.agent.transport.bus.BusError: the bus cannot be opened, or is not wanted any more.
        handfast.deploy.console.arguments.InputError: nor can it with this operator's certificate.
    """

    def __init__(self, fleet: Fleet, stopping: Stopping, is_wanted: Callable[[], bool]) -> None:
        super().__init__(fleet, operator_bus(fleet, whenever=True, is_wanted=is_wanted))
        name = fleet.fleet.name
        self._key = key_expressions.stop(name)
        self.bus.declare(self._key)
        self._stopping = stopping
        self.again_s: Final = again_s(fleet)
        self._sent_to, self._sent, self._sent_s = 0, stopping.message, 0.0
        # Before all else: what is connected already must not wait for the rest.
        self.send()
        for key in (key_expressions.status(name, "*"), key_expressions.plant_state(name, "*")):
            self.bus.subscribe(key, INBOX)

    def feed(self, key: str, message: Message) -> None:
        self._stopping.feed(self.now_ns(), key, message)

    def send(self) -> None:
        """Sends the stop to all that are connected."""
        self._sent_to, self._sent = len(self.alive), self._stopping.message
        self._sent_s = time.monotonic()
        self.bus.publish(self._key, encode(self._sent))

    @property
    def is_to_send(self) -> bool:
        """Whether a process has come since the stop was sent last, or the stop got a greater version. Those
        of a large fleet come one after the other: not all are told again for each."""
        if self._stopping.message is not self._sent:
            return True
        has_paused = time.monotonic() >= self._sent_s + self.again_s - AGAIN_S
        return has_paused and len(self.alive) > self._sent_to


class OtherWays:
    """All ways besides new links."""

    def __init__(self, ways: Sequence[Way], stopping: Stopping) -> None:
        self._ways, self._stopping = ways, stopping
        self._sent: Stop | None = None

    def send(self) -> None:
        """Sends the stop, unless it was sent as it is now."""
        if self._stopping.message is not self._sent:
            self._sent = self._stopping.message
            for way in self._ways:
                way.send(self._sent)

    def collect(self) -> None:
        """Takes what has come back until now, and sends the stop again if that has changed it."""
        for way in self._ways:
            way.collect(self._stopping)
        self.send()

    @property
    def busy(self) -> bool:
        return any(way.busy for way in self._ways)


def stop(fleet: Fleet, reason: str, ways: Sequence[Way] = ()) -> tuple[Stopping, list[str]]:
    """What became of a stop of a running fleet, and what did not work of the ways by which it was sent.

    It is sent again, at once to every process that comes, until all brake; a while later that is given up.

    Args:
        ways: by which it goes besides new links; they are closed.

    Raises:
        handfast.deploy.inventory.known_fleets.NoAnswerError: nobody is there, by any way.
        handfast.agent.transport.bus.BusError: there is no other way, and the bus cannot be opened.
        handfast.deploy.console.arguments.InputError: nor can it with this operator's certificate, and nobody
        is heard
            by any other way.
    """
    begun = time.monotonic()
    stopping = Stopping(fleet, time.time_ns(), reason)
    troubles: list[str] = []
    with ExitStack() as stack:
        for way in ways:
            stack.callback(way.close)
        others = OtherWays(ways, stopping)
        others.send()
        own = OwnOrders(fleet)
        stopping.outdo(
            max((each.version for each in own.orders if not isinstance(each, Mission)), default=-1)
        )
        others.send()

        def is_wanted() -> bool:  # a router that does not answer is waited for
            others.collect()
            return not stopping.settled

        session: StopSession | None = None
        why: Exception | None = None
        try:
            session = stack.enter_context(StopSession(fleet, stopping, is_wanted))
            begun = time.monotonic()
        except (BusError, InputError) as error:
            if not ways:
                raise
            troubles.append(f"not over new links: {error}")
            why = error
        own.keep(stopping.message)
        _follow(stopping, session, others, begun)
        (own.put if stopping.ahead_s else own.keep)(stopping.message)
        if isinstance(why, InputError) and not stopping.heard:
            raise why
        if session is not None and not stopping.heard and not session.alive and not _said(ways):
            raise session.no_answer()
    own.warn()
    return stopping, [*troubles, *_said(ways)]


def _follow(stopping: Stopping, session: StopSession | None, others: OtherWays, begun: float) -> None:
    """Sends the stop again, and takes what comes back, until all brake or nothing more may come.

    Args:
        begun: since when they could answer (`time.monotonic`).
    """

    def look() -> bool:
        others.collect()
        return stopping.settled or (session is not None and session.is_to_send)

    while not stopping.settled:
        waited_s = time.monotonic() - begun
        if waited_s >= ANSWER_S:
            more = waited_s < WAIT_S and (stopping.is_being_kept or others.busy)
            if not more:
                look()  # a way may have told its last between the look before and its end
                return
        if session is not None:
            session.wait(look, session.again_s)
            session.send()
        elif not look():
            time.sleep(AGAIN_S)


def _said(ways: Iterable[Way]) -> list[str]:
    return [trouble for way in ways for trouble in way.troubles]
