"""Asks a vehicle for its messages at a rate, and watches that they come (PURE).

A vehicle sends little unless it is asked (SET_MESSAGE_INTERVAL), forgets what it was asked at a reboot, and
does what the last one asked who shares its link. So what is granted is also counted, and asked for again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants

LOWER_RATES_HZ: Final = (25.0, 20.0, 12.5, 10.0, 5.0)
"""Tried in turn when a state message is refused; whole milliseconds, as ArduPilot counts them."""
KEPT_PART: Final = 0.7
"""Less than this part of the granted rate is not what was granted."""
WINDOW_NS: Final = 3 * NS_PER_S
_WINDOW_MESSAGES: Final = 5
_BACK_OFF_MAX_NS: Final = 30 * NS_PER_S
_REPEAT_NS: Final = 3 * NS_PER_S
_REJECTED_NS: Final = 2 * NS_PER_S
_KEPT: Final = 256


class Wanted(NamedTuple):
    """A message to be asked for at the first of `rates_hz` that is granted."""

    message: int
    name: str
    rates_hz: tuple[float, ...]


class StreamRow(NamedTuple):
    """What became of one message.

    `granted_hz` is None until the vehicle accepted a rate; `measured_hz` counts over the last 3 s or five
    messages. `answer` is "waiting", "accepted", "denied" or "no answer".
    """

    name: str
    asked_hz: float
    granted_hz: float | None
    measured_hz: float
    answer: str


def wanted_messages(state_rate_hz: float) -> tuple[Wanted, ...]:
    """The messages that a bridge needs, the two of the state at `state_rate_hz`.

    HEARTBEAT more often than its 1 Hz, since the operator's change of mode is in it.
    """
    rates = (state_rate_hz, *(rate for rate in LOWER_RATES_HZ if rate < state_rate_hz))
    return (
        Wanted(constants.MESSAGE_ATTITUDE, "ATTITUDE", rates),
        Wanted(constants.MESSAGE_LOCAL_POSITION_NED, "LOCAL_POSITION_NED", rates),
        Wanted(constants.MESSAGE_HEARTBEAT, "HEARTBEAT", (5.0,)),
        Wanted(constants.MESSAGE_EKF_STATUS_REPORT, "EKF_STATUS_REPORT", (2.0,)),
        Wanted(constants.MESSAGE_SYS_STATUS, "SYS_STATUS", (1.0,)),
        Wanted(constants.MESSAGE_GPS_RAW_INT, "GPS_RAW_INT", (1.0,)),
    )


FENCE: Final = Wanted(constants.MESSAGE_FENCE_STATUS, "FENCE_STATUS", (1.0,))
"""Asked for of a vehicle only that has a fence of its own, which may hold it back or take it."""


class _Stream:
    def __init__(self, wanted: Wanted) -> None:
        self.wanted = wanted
        self.arrivals: deque[int] = deque(maxlen=_KEPT)
        self.restart()

    def restart(self) -> None:
        self.step = 0
        self.answer = "waiting"
        self.granted = False
        self.since_ns = 0
        self.due_ns: int | None = 0
        self.back_off_ns = 0
        self.arrivals.clear()

    @property
    def rate_hz(self) -> float:
        return self.wanted.rates_hz[self.step]

    @property
    def window_ns(self) -> int:
        return max(WINDOW_NS, round(_WINDOW_MESSAGES / self.rate_hz * NS_PER_S))

    def measured_hz(self, now_ns: int) -> float:
        arrivals, window_ns = self.arrivals, self.window_ns
        while arrivals and arrivals[0] <= now_ns - window_ns:
            arrivals.popleft()
        count = len(arrivals)
        if count < 2 or (now_ns - arrivals[-1]) * self.rate_hz > 2 * NS_PER_S:
            return count * NS_PER_S / window_ns
        if arrivals[-1] <= arrivals[0]:
            return 0.0  # all in one lump
        return (count - 1) * NS_PER_S / (arrivals[-1] - arrivals[0])

    def look(self, now_ns: int) -> None:
        """Has it asked for again when less comes than was granted."""
        if not self.granted or self.due_ns is not None or now_ns - self.since_ns < self.window_ns:
            return
        if self.measured_hz(now_ns) >= KEPT_PART * self.rate_hz:
            self.back_off_ns = 0
        elif now_ns - self.since_ns >= self.window_ns + self.back_off_ns:
            self.back_off_ns = min(_BACK_OFF_MAX_NS, max(WINDOW_NS, 2 * self.back_off_ns))
            self.due_ns = now_ns

    def answered(self, now_ns: int, result: int | None) -> None:
        self.since_ns, self.due_ns = now_ns, None
        if result == constants.RESULT_ACCEPTED:
            if not self.granted:
                self.arrivals.clear()  # what came until now came at another rate
            self.answer, self.granted = "accepted", True
        elif result is None:
            self.answer = "no answer"
            self.due_ns = now_ns + _REPEAT_NS
        elif result == constants.RESULT_TEMPORARILY_REJECTED:
            self.due_ns = now_ns + _REJECTED_NS
        else:
            self.answer, self.granted = "denied", False
            if self.step + 1 < len(self.wanted.rates_hz):
                self.step += 1
                self.answer, self.due_ns = "waiting", now_ns


class Streams:
    """The requests of one session, one at a time: an answer does not say which message it is about."""

    def __init__(self, wanted: Sequence[Wanted]) -> None:
        self._wanted = tuple(wanted)
        self.restart()

    def restart(self) -> None:
        """The vehicle has forgotten: everything is asked for anew, and what was wanted besides is not."""
        self._asked: _Stream | None = None
        self._streams = {entry.message: _Stream(entry) for entry in self._wanted}

    def want(self, wanted: Wanted) -> None:
        """One more, until the next restart."""
        if wanted.message not in self._streams:
            self._streams[wanted.message] = _Stream(wanted)

    def heard(self, message: int, arrival_ns: int) -> None:
        """A message came. Those that nobody asked for are ignored."""
        stream = self._streams.get(message)
        if stream is not None:
            stream.arrivals.append(arrival_ns)

    def ask(self, now_ns: int) -> tuple[int, int] | None:
        """The next request, message id and interval in us, while no other is under way."""
        if self._asked is not None:
            return None
        for stream in self._streams.values():
            stream.look(now_ns)
            if stream.due_ns is not None and now_ns >= stream.due_ns:
                self._asked = stream
                return stream.wanted.message, round(1e6 / stream.rate_hz)
        return None

    def answered(self, now_ns: int, result: int | None) -> None:
        """The answer (MAV_RESULT) to the request under way, None when none came."""
        if self._asked is not None:
            self._asked.answered(now_ns, result)
            self._asked = None

    def cancelled(self) -> None:
        """The request under way was given up: it is made again."""
        self._asked = None

    def rows(self, now_ns: int) -> list[StreamRow]:
        """The table, in the order of asking."""
        return [
            StreamRow(
                stream.wanted.name,
                stream.wanted.rates_hz[0],
                stream.rate_hz if stream.granted else None,
                stream.measured_hz(now_ns),
                stream.answer,
            )
            for stream in self._streams.values()
        ]
