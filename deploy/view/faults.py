"""Fault rules that pages set on links of a running fleet: each with its lease, until its time is over."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import AUTHOR_MAX, EVERY_AUTHOR, Faults, Message
from handfast.agent.transport.bus import Bus
from handfast.deploy.drive.fleet_state import FleetState
from handfast.deploy.faults.live import (
    Held,
    LiveRulesError,
    LiveSet,
    Receiver,
    receivers,
    rule_of_options,
    text_of,
)
from handfast.deploy.session.faults import ECHO_S, LEASE_NS, Putting, names
from handfast.deploy.view.orders import RefusedError

FIELDS: Final = frozenset({"link", "robot", "loss", "delay", "for"})
"""Of a rule that a page may give."""


class LiveFaults:
    """Live rules over the links of who follows a fleet (`deploy.session.faults.Operator`).

    Attributes:
        held: who holds which rules.
        healed_ns: when all rules were ended from here last.
    """

    def __init__(self, state: FleetState, bus: Bus) -> None:
        self.fleet: Final[Fleet] = state.fleet
        self.receivers: Final[Sequence[Receiver]] = receivers(state.fleet)
        self.held: Final = Held(state.fleet)
        self._state, self._bus = state, bus
        self._key = key_expressions.faults(state.fleet.fleet.name)
        self.healed_ns = 0
        self._version = self._authors = 0
        bus.declare(self._key)

    @property
    def author(self) -> str:
        """Another one for each set of rules: a set replaces those of its author."""
        self._authors += 1
        part = f"/{self._authors}"
        return self._state.author[: AUTHOR_MAX - len(part)] + part

    def now_ns(self) -> int:
        return self._state.clock.now_ns()

    def version(self) -> int:
        """Greater than all that are known."""
        newest = max((each.message.version for each in self.sets()), default=0)
        self._version = max(self._version + 1, newest + 1, self.now_ns() // 1_000_000)
        return self._version

    def send(self, message: Faults) -> None:
        self._bus.publish(self._key, encode(message))

    def feed(self, _: int, key: str, message: Message) -> None:
        """Takes a message that came on `key`."""
        if type(message) is Faults:
            self.held.feed(key, message)

    def sets(self) -> list[LiveSet]:
        """The live rules that are held now; who is not there holds none."""
        for receiver in self.receivers:
            if receiver not in self._state.present:
                self.held.forget(receiver)
        return self.held.sets(self.now_ns())

    def collect(self) -> None:
        """Nothing: who follows the fleet collects."""

    def pause(self) -> None:
        """Nothing: this is one of several things that are done in turn."""

    def wait(self, look: Callable[[], bool], _: float) -> bool:
        """What is so now."""
        return look()


class FaultUnderWay:
    """One rule.

    Raises:
        RefusedError: it is none that a running fleet takes, or never ends.
    """

    def __init__(self, faults: LiveFaults, content: Mapping[str, Any]) -> None:
        given = content.get("rule")
        if not isinstance(given, Mapping) or not given.keys() <= FIELDS or "for" not in given:
            raise RefusedError(f"a rule gives for and some of {', '.join(sorted(FIELDS - {'for'}))}")
        try:
            rule = rule_of_options({str(key): str(value) for key, value in given.items()}, faults.fleet.ids)
            text = text_of([rule])
        except LiveRulesError as error:
            raise RefusedError("; ".join(str(error).splitlines())) from None
        self._faults = faults
        self._putting = Putting(faults, [rule], text, lambda: False, io.StringIO(), stay=False)
        self._begun_ns = faults.now_ns()
        self._healed_ns: int | None = None
        self.is_over = self.done = False
        self.what: Final = self._putting.what
        self.step(faults.now_ns())

    @property
    def count(self) -> tuple[int, int]:
        return len(self._putting.took), len(self._faults.receivers)

    def lines(self) -> list[str]:
        missing = self._putting.missing
        lines = [f"not held by {names(missing)}"] if missing else []
        if self._putting.cleared:
            return [*lines, "healed" if self._is_healed else "ended by another operator"]
        if self.is_over and (left := self._putting.holders):
            lease_s = LEASE_NS / NS_PER_S
            return [*lines, f"not heard to be healed: {names(left)}; the lease ends in {lease_s:.0f} s"]
        return lines

    @property
    def _is_healed(self) -> bool:
        """Whether it was ended from here, on purpose."""
        return self._faults.healed_ns > self._begun_ns

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Nothing: `LiveFaults` hears for all."""

    def step(self, now_ns: int) -> None:
        if self._healed_ns is None:
            if not self._putting.step():
                return
            self._healed_ns = now_ns
            if not self._putting.cleared:
                self._putting.take_back()
        if not self._putting.holders or now_ns - self._healed_ns > ECHO_S * NS_PER_S:
            self.is_over = True
            as_meant = self._is_healed or not self._putting.cleared
            self.done = as_meant and not self._putting.missing and not self._putting.holders


class HealUnderWay:
    """The end of the live rules of all operators."""

    what: Final = "heal all links"

    def __init__(self, faults: LiveFaults) -> None:
        self._faults = faults
        now_ns = self._begun_ns = faults.now_ns()
        self._sets = faults.sets()
        if not self._sets:
            raise RefusedError("there are no live faults")
        faults.healed_ns = now_ns
        faults.send(Faults(faults.version(), now_ns, EVERY_AUTHOR, now_ns, 0, ""))
        self.is_over = False

    @property
    def _left(self) -> list[Receiver]:
        still = {each.message.author: each.holders for each in self._faults.sets()}
        left = {holder for each in self._sets for holder in still.get(each.message.author, ())}
        return sorted(left, key=self._faults.receivers.index)

    @property
    def done(self) -> bool:
        return not self._left

    @property
    def count(self) -> tuple[int, int]:
        had = {holder for each in self._sets for holder in each.holders}
        return len(had) - len(set(self._left) & had), len(had)

    def lines(self) -> list[str]:
        return [f"not heard to be healed: {names(left)}"] if (left := self._left) else []

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Nothing: `LiveFaults` hears for all."""

    def step(self, now_ns: int) -> None:
        self.is_over = self.done or now_ns - self._begun_ns > ECHO_S * NS_PER_S
