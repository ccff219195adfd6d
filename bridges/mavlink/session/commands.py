"""Sends commands until they are acknowledged (PURE)."""

from __future__ import annotations

from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants

TRIES: Final = 3
ANSWER_TIMEOUT_NS: Final = NS_PER_S

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
            if pending.tries >= TRIES:
                del self._pending[command]
                self._outcomes[command] = Outcome("no answer")
                continue
            self._pending[command] = _Pending(pending.values, pending.tries + 1, now_ns + ANSWER_TIMEOUT_NS)
            out.append((command, pending.tries, pending.values))
        return out

    def no_more(self, command: int) -> None:
        """The command is not repeated; its answer may still come. For one that was overtaken by events."""
        pending = self._pending.get(command)
        if pending is not None and pending.tries:
            self._pending[command] = pending._replace(tries=TRIES)

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
            self._pending[command] = pending._replace(due_ns=arrival_ns + 5 * ANSWER_TIMEOUT_NS)
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
