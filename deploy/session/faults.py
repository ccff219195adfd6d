"""An operator's session that sends live fault rules to a running fleet and hears who holds them."""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isinf
from typing import Final, Protocol, TextIO

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import AUTHOR_MAX, EVERY_AUTHOR, Faults, Message, PlantState
from handfast.deploy.console.wording import some
from handfast.deploy.faults.live import Held, Receiver
from handfast.deploy.faults.rules import end_of, words
from handfast.deploy.session.session import INBOX, Session


def author() -> str:
    """This process: ``user@host:pid``."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # an id without a name
        user = str(os.getuid())
    text = f"{user}@{socket.gethostname()}"
    pid = f":{os.getpid()}"
    return "".join(c if c.isprintable() else "?" for c in text)[: AUTHOR_MAX - len(pid)] + pid


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


ORIGIN_AHEAD_NS: Final = 3 * NS_PER_S // 10
"""The rules are everywhere this long before they begin: all receivers begin at the same stamps."""
LEASE_NS: Final = 2 * NS_PER_S
SEND_PERIOD_NS: Final = NS_PER_S // 2
SHOW_PERIOD_NS: Final = NS_PER_S // 4
ECHO_S: Final = 1.5
"""Receivers say at least once a second what they hold."""
TAKE_S: Final = 2.5
"""Receivers that have not taken the rules by then are named."""
GONE_NS: Final = 2 * NS_PER_S
"""Rules that a receiver had and has not taken again for so long were cleared."""
AFTER_END_NS: Final = 3 * NS_PER_S // 10
"""The rules stay for this long after their end, for messages of that time that are on their way."""
RULES_SHOWN: Final = 4


class NothingToClearError(LookupError):
    """There are no live rules of the author that was named."""


class Operator(Protocol):
    """What is needed of a session with a fleet (`deploy.session.faults.FaultsSession`)."""

    @property
    def fleet(self) -> Fleet: ...
    @property
    def receivers(self) -> Sequence[Receiver]: ...
    @property
    def author(self) -> str: ...
    @property
    def held(self) -> Held: ...
    def now_ns(self) -> int: ...
    def version(self) -> int: ...
    def send(self, message: Faults) -> None: ...
    def wait(self, look: Callable[[], bool], timeout_s: float) -> bool: ...
    def collect(self) -> None: ...
    def pause(self) -> None: ...


class Putting:
    """Puts `rules` into force, `text` as a message carries them, and keeps them there until they end.

    Args:
        interrupted: whether the user wants to end.
        stream: where to say how it goes.
        stay: leave them in force, and end as soon as everybody has them.

    After `run`: `took`, the receivers that have held the rules; `cleared`, whether another operator has
    ended them; `early`, whether the user has before their end.
    """

    def __init__(
        self,
        session: Operator,
        rules: Sequence[Rule],
        text: str,
        interrupted: Callable[[], bool],
        stream: TextIO,
        *,
        stay: bool,
    ) -> None:
        self._session, self._interrupted, self._stay = session, interrupted, stay
        now_ns = session.now_ns()
        self._message = Faults(
            session.version(),
            now_ns,
            session.author,
            now_ns + ORIGIN_AHEAD_NS,
            0 if stay else LEASE_NS,
            text,
        )
        end_s = max(map(end_of, rules))
        self._end_ns = None if isinf(end_s) else self._message.origin_ns + round(end_s * NS_PER_S)
        more = len(rules) - RULES_SHOWN
        self.what: Final = "; ".join(map(words, rules[:RULES_SHOWN])) + (
            f"; and {more} more" if more > 0 else ""
        )
        self._line = Line(stream)
        self._send_ns = self._show_ns = 0
        self._give_up_ns = now_ns + round(TAKE_S * NS_PER_S)
        self._gone_ns: dict[Receiver, int] = {}
        self.took: set[Receiver] = set()
        self.cleared = self.early = False

    def run(self) -> None:
        """Keeps the rules in force until they end, and heals."""
        while not self._interrupted() and not self.step():
            self._session.pause()
        self.early = self._interrupted() and (self._stay or self._end_ns is not None)
        if not self._stay and not self.cleared:
            self._heal()
        self._line.end()

    @property
    def missing(self) -> list[Receiver]:
        """Receivers that have not said that they hold the rules."""
        return [each for each in self._session.receivers if each not in self.took]

    def step(self) -> bool:
        """Sends the rules again where that is due, and looks who holds them; True when they are over, or all
        have them that are to keep them."""
        now_ns = self._session.now_ns()
        if now_ns >= self._send_ns:
            self._send_ns = now_ns + SEND_PERIOD_NS
            self._message = self._message._replace(time_ns=now_ns)
            self._session.send(self._message)
        self._session.collect()
        self._look(now_ns)
        if now_ns >= self._show_ns:
            self._show_ns = now_ns + SHOW_PERIOD_NS
            self._show(now_ns)
        over = self._stay or (self._end_ns is not None and now_ns >= self._end_ns + AFTER_END_NS)
        return self.cleared or (over and (not self.missing or now_ns >= self._give_up_ns))

    def _look(self, now_ns: int) -> None:
        """Notes who holds the rules, and whether another operator has ended them."""
        message = self._message
        for receiver in self._session.receivers:
            echo = self._session.held.echo(receiver, message.author)
            if echo is None or echo.version < message.version:
                continue
            if echo.rules:
                self.took.add(receiver)
                self._gone_ns.pop(receiver, None)
            elif echo.version > message.version:
                self.cleared = True
            elif now_ns - self._gone_ns.setdefault(receiver, now_ns) > GONE_NS:
                # One that had only not heard us for a while would have taken them again by now.
                self.cleared = True

    def _show(self, now_ns: int) -> None:
        held = f"held by {len(self.took)} of {len(self._session.receivers)}"
        left = ""
        if not self._stay and self._end_ns is not None:
            left = f"; {max(0.0, (self._end_ns - now_ns) / NS_PER_S):.1f} s left"
        elif not self._stay:
            left = "; until Ctrl-C"
        self._line.show(f"{self.what}; {held}{left}", held)

    def take_back(self) -> None:
        """Takes the rules back."""
        session = self._session
        session.send(self._message._replace(version=session.version(), time_ns=session.now_ns(), rules=""))

    @property
    def holders(self) -> list[Receiver]:
        """Those that had the rules, and have not said yet that they hold them no more."""
        return holders(self._session, {receiver: [self._message] for receiver in self.took})

    def _heal(self) -> None:
        """Takes the rules back, and waits until all who had them say so."""
        self.take_back()
        if not self._session.wait(lambda: not self.holders, ECHO_S):
            left = names(self.holders)
            self._line.end()
            lease_s = LEASE_NS / NS_PER_S
            self._line.show(f"not heard to be healed: {left}; there the lease ends in {lease_s:.0f} s", "")


def holders(session: Operator, given: Mapping[Receiver, Iterable[Faults]]) -> list[Receiver]:
    """Receivers that last said that they hold rules of the author of one of the sets `given` for each."""
    out = []
    for receiver, messages in given.items():
        echoes = (session.held.echo(receiver, message.author) for message in messages)
        if any(echo is not None and echo.rules for echo in echoes):
            out.append(receiver)
    return sorted(out, key=session.receivers.index)


def clear(session: Operator, author: str | None) -> tuple[list[str], list[Receiver]]:
    """Ends the live rules of `author`, or of all; returns whose they were, and who still seems to hold them.

    Raises:
        NothingToClearError: the author who is named has none.
    """
    session.wait(lambda: False, ECHO_S)
    sets = session.held.sets(session.now_ns())
    going = [each for each in sets if author in (None, each.message.author)]
    if not going and author is not None:
        known = ", ".join(each.message.author for each in sets) or "nobody"
        raise NothingToClearError(f"there are no live faults of {author}; there are those of {known}")
    if not going:
        return [], []
    now_ns = session.now_ns()
    # One author's empty set need not outlive the command of that author, which sees it and ends.
    who, lease_ns = (EVERY_AUTHOR, 0) if author is None else (author, 2 * LEASE_NS)
    session.send(Faults(session.version(), now_ns, who, now_ns, lease_ns, ""))
    given: dict[Receiver, list[Faults]] = {}
    for each in going:
        for receiver in each.holders:
            given.setdefault(receiver, []).append(each.message)
    session.wait(lambda: not holders(session, given), ECHO_S)
    return [each.message.author for each in going], holders(session, given)


class Line:
    """One line that is redrawn on a terminal; elsewhere a plain line, again only when `key` changes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._live = stream, stream.isatty()
        self._key: str | None = None

    def show(self, text: str, key: str) -> None:
        if self._live:
            print(f"\r\033[K{text}", end="", file=self._stream, flush=True)
        elif key != self._key:
            print(text, file=self._stream, flush=True)
        self._key = key

    def end(self) -> None:
        """Leaves the last line standing."""
        if self._live and self._key is not None:
            print(file=self._stream, flush=True)
        self._key = None


def names(receivers: Sequence[Receiver]) -> str:
    """The processes in words: ``robot 3's plant, robot 4's agent and plant``."""
    roles: dict[int, list[str]] = {}
    for robot, role in receivers:
        roles.setdefault(robot, []).append(role)
    return some(f"robot {robot}'s {' and '.join(those)}" for robot, those in roles.items())
