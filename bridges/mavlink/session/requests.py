"""Requests that are repeated until the vehicle answers: commands, and parameters read by name (PURE)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants, steering

COMMAND_TRIES: Final = 3
COMMAND_TIMEOUT_NS: Final = NS_PER_S

Parameters7 = tuple[float, float, float, float, float, float, float]


class Outcome(NamedTuple):
    """What became of a command.

    `state` is "waiting", "accepted", "refused" (`result` says how, MAV_RESULT) or "no answer".
    """

    state: str
    result: int | None = None

    @property
    def text(self) -> str:
        """The outcome in words."""
        if self.state == "refused" and self.result is not None:
            return constants.RESULT_NAMES.get(self.result, f"refused with result {self.result}")
        return self.state


class _Pending(NamedTuple):
    values: Parameters7
    tries: int
    due_ns: int


class Commands:
    """At most one of each MAV_CMD is under way: an answer names the command, not its values."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}
        self._outcomes: dict[int, Outcome] = {}

    def restart(self) -> None:
        """Nothing that was asked is still wanted."""
        self._pending.clear()
        self._outcomes.clear()

    @property
    def waiting(self) -> bool:
        """Whether any is under way."""
        return bool(self._pending)

    def give(self, command: int, *values: float) -> None:
        """Asks for a command with up to seven values, in place of an earlier one of that number."""
        padded = (*values, *([0.0] * (7 - len(values))))
        self._pending[command] = _Pending(padded, 0, 0)  # type: ignore[arg-type]  # seven of them
        self._outcomes[command] = Outcome("waiting")

    def due(self, now_ns: int) -> list[tuple[int, int, Parameters7]]:
        """What is to be sent now: command, its confirmation (count of repetitions), values."""
        out = []
        for command, pending in list(self._pending.items()):
            if pending.tries and now_ns < pending.due_ns:
                continue
            if pending.tries >= COMMAND_TRIES:
                del self._pending[command]
                self._outcomes[command] = Outcome("no answer")
                continue
            self._pending[command] = _Pending(pending.values, pending.tries + 1, now_ns + COMMAND_TIMEOUT_NS)
            out.append((command, pending.tries, pending.values))
        return out

    def no_more(self, command: int) -> None:
        """The command is not repeated; its answer may still come. For one that was overtaken by events."""
        pending = self._pending.get(command)
        if pending is not None and pending.tries:
            self._pending[command] = pending._replace(tries=COMMAND_TRIES)

    def cancel(self) -> None:
        """Nothing that waits is sent, or sent again."""
        for command in self._pending:
            self._outcomes[command] = Outcome("no answer")
        self._pending.clear()

    def answered(self, arrival_ns: int, command: int, result: int) -> bool:
        """A COMMAND_ACK came; one that nobody waits for is ignored, and False."""
        pending = self._pending.get(command)
        if pending is None or not pending.tries:
            return False
        if result == constants.RESULT_IN_PROGRESS:
            self._pending[command] = pending._replace(due_ns=arrival_ns + 5 * COMMAND_TIMEOUT_NS)
            return True
        del self._pending[command]
        state = "accepted" if result == constants.RESULT_ACCEPTED else "refused"
        self._outcomes[command] = Outcome(state, result)
        return True

    def outcome(self, command: int) -> Outcome | None:
        """What became of the last such command, None when there was none."""
        return self._outcomes.get(command)

    def take(self, command: int) -> Outcome | None:
        """The outcome, once, when there is nothing more to wait for."""
        outcome = self._outcomes.get(command)
        if outcome is None or outcome.state == "waiting":
            return None
        return self._outcomes.pop(command)


AUDITED: Final = (
    # First what limits the motion, which the bridge itself needs.
    constants.WP_SPEED,
    constants.ATC_ACCEL_MAX,
    constants.ATC_STR_RAT_MAX,
    constants.ATC_TURN_MAX_G,
    constants.GROUND_STATION_ID[0],
    *steering.USUAL,
    constants.GROUND_STATION_ID[1],
    constants.FENCE_ENABLE,
    constants.GUID_TIMEOUT,
    constants.SCHED_LOOP_RATE,
    constants.FS_ACTION,
    constants.FS_THR_ENABLE,
    constants.FS_GCS_ENABLE,
    constants.FS_EKF_ACTION,
    constants.FS_EKF_THRESH,
    constants.FS_CRASH_CHECK,
    *constants.ARMING_CHECK,
    constants.BATT_FS_LOW_ACT,
    constants.BATT_FS_CRT_ACT,
    constants.BATT_LOW_VOLT,
)
"""Where firmware versions differ in a name, both: the one that answers counts."""
RENAMED: Final = (constants.GROUND_STATION_ID, constants.ARMING_CHECK)
"""Pairs of names of which a firmware has one: once that has answered, the other is not asked for."""


def further(values: Mapping[str, float | None]) -> tuple[str, ...]:
    """What to read besides, by what was read: not every vehicle has to be asked for it over its link."""
    fenced = values.get(constants.FENCE_ENABLE)
    avoidance = (constants.AVOID_ENABLE,) if fenced else ()
    return (*(name for name in avoidance if name not in values), *steering.to_read(values))


IN_FLIGHT: Final = 4
SPACING_NS: Final = NS_PER_S // 10
ANSWER_TIMEOUT_NS: Final = 3 * NS_PER_S // 2
TRIES: Final = 6
"""Over a radio that loses 30 % each way, one in fifty goes unanswered so often; three times, one in eight."""


class Parameters:
    """Asks for the parameters `names`, and those that are to be read `further`, and keeps their values.

    Args:
        further: from the values so far, the names to read besides, () when there are none.

    Attributes:
        values: by name; None for one that the vehicle does not have: it leaves such a request unanswered
            (or, newest firmware, says so). One that is still being asked for is missing.
        changes: grows whenever a value may have changed.
    """

    def __init__(
        self,
        names: Sequence[str] = AUDITED,
        further: Callable[[Mapping[str, float | None]], Sequence[str]] = further,
    ) -> None:
        self._first = tuple(dict.fromkeys(names))
        self._further = further
        self.values: dict[str, float | None] = {}
        self.changes = 0
        self.restart()

    def restart(self) -> None:
        """Reads everything anew."""
        self.values.clear()
        self.changes += 1
        self._names = dict.fromkeys(self._first)
        self._tries = dict.fromkeys(self._first, 0)
        self._waiting: dict[str, int] = {}
        self._last_ns: int | None = None

    @property
    def done(self) -> bool:
        """Whether each has answered or is taken to be missing."""
        return not self._tries

    def first(self, names: str | Sequence[str]) -> float | None:
        """The value of the first of these names that the vehicle has, None while there is none."""
        for name in (names,) if isinstance(names, str) else names:
            value = self.values.get(name)
            if value is not None:
                return value
        return None

    def ask(self, now_ns: int) -> str | None:
        """The name to ask for now, at most one in 0.1 s; None when there is nothing to do."""
        if self.done:
            return None
        for name, sent_ns in list(self._waiting.items()):
            if now_ns - sent_ns >= ANSWER_TIMEOUT_NS:
                del self._waiting[name]
                if self._tries[name] >= TRIES:
                    self.missing(name)
        if len(self._waiting) >= IN_FLIGHT or not self._tries:
            return None
        if self._last_ns is not None and now_ns - self._last_ns < SPACING_NS:
            return None
        name = min(
            (n for n in self._tries if n not in self._waiting), key=self._tries.__getitem__, default=""
        )
        if not name:
            return None
        self._tries[name] += 1
        self._waiting[name] = now_ns
        self._last_ns = now_ns
        return name

    def received(self, name: str, value: float) -> bool:
        """A value came, asked for or changed by somebody else; False for one that is not finite."""
        if name not in self._names:
            return True
        if not isfinite(value):
            return False
        self.values[name] = value
        self._settle(name)
        for pair in RENAMED:
            if name in pair:
                self.missing(pair[pair[0] == name])
        return True

    def missing(self, name: str) -> None:
        """The vehicle has no such parameter."""
        if name in self._tries:
            self.values[name] = None
            self._settle(name)

    def _settle(self, name: str) -> None:
        self.changes += 1
        self._tries.pop(name, None)
        self._waiting.pop(name, None)
        more = [each for each in self._further(self.values) if each not in self._names]
        self._names.update(dict.fromkeys(more))
        self._tries.update(dict.fromkeys(more, 0))
