"""When a robot's hand state is sent that is not sent in every tick: event-triggered, by a model (PURE).

Neighbours carry a robot's last hand state forward (P1). So does the robot itself, from the last one that it
has sent: while what it does is what they expect, there is nothing to say. One that says something new is
sent again after intervals that double (`agent.messages.trickle_timer`), for who has missed it. Each says
within how long the next one comes at the latest. See (E1) of docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import hypot
from typing import Final

from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.prediction import Prediction, as_it_came, coasting
from handfast.agent.control.peers.rolling import ROLL_ERROR
from handfast.agent.messages.trickle_timer import TrickleTimer
from handfast.agent.messages.types import HEARD_ROUNDS, HandState

LOOKAHEAD_S: Final = 0.5
"""Places are compared so long after the tick: a velocity that is off counts by what it makes of them until
then, and so does a force. It is longer than the age of any message on a usable link."""
HEARD_OFF_US: Final = 2000
"""A neighbour's clock is told of at once if it is known so much better than when it was last told of."""

Slopes = Callable[[], Mapping[int, float]]
"""How much force a multiplier makes, 1/m, by the other robot: `agent.control.couplings.Coupling.slopes`."""


class EventTrigger:
    """What robot's neighbours have of it, and whether that will do.

    Args:
        forecast: by which they carry its hand states forward.
        period_ns: of its ticks.
        bound_m: how far what they expect may be off, (E1).
        most_ns: within so long one is sent, whatever happens.
        predicts: whether their law carries it forward (`control.prediction`).
        slopes: of its multipliers.
        missed: how many messages its links miss in a row, where nothing else comes in between that would
            show that it is there: it says it the oftener then. None: something does.
    """

    def __init__(
        self,
        forecast: Forecast,
        period_ns: int,
        bound_m: float,
        most_ns: int,
        *,
        predicts: bool,
        slopes: Slopes,
        missed: Callable[[], float] | None = None,
    ) -> None:
        self._forecast, self._bound_m, self._predicts, self._slopes = forecast, bound_m, predicts, slopes
        self._period_ns, self._missed = period_ns, missed
        self._timer = TrickleTimer(period_ns, max(period_ns, most_ns // period_ns * period_ns))
        self._last: HandState | None = None
        self._heard: tuple[tuple[int, int], ...] = ()
        self._heard_ns = 0

    def missed(self) -> None:
        """Somebody may lack the last one, or not know how to carry it forward: the next tick sends one."""
        self._timer.changed()

    def next_ms(self, message: HandState, round_ns: int) -> int | None:
        """Within how long the next one comes if `message`, which holds at this tick, is sent now; None where
        it need not be.

        Args:
            round_ns: when this tick is on the grid: one that comes late is none the later for the next one.
        """
        last, timer = self._last, self._timer
        if last is None or self._is_off(last, message):
            timer.changed()
        if not timer.is_due(round_ns):
            return None
        self._last = message
        most_ns = None
        if self._missed is not None:
            most_ns = round(timer.most_ns / (1.0 + self._missed())) // self._period_ns * self._period_ns
        return -(-timer.said(round_ns, most_ns=most_ns) // NS_PER_MS)

    def echo(self, heard: tuple[tuple[int, int], ...], round_ns: int) -> tuple[tuple[int, int], ...]:
        """Which of `heard` to say with a message that is sent now."""
        if not heard or round_ns - self._heard_ns < HEARD_ROUNDS * self._period_ns:
            return ()
        self._heard, self._heard_ns = heard, round_ns
        return heard

    def hears(self, heard: tuple[tuple[int, int], ...]) -> None:
        """Takes what it would echo now: of whom it has not told, it does so at once."""
        if heard is not self._heard and _is_news(dict(self._heard), heard):
            self._timer.changed()

    def _is_off(self, last: HandState, message: HandState) -> bool:
        """Whether `message` has something that its neighbours do not expect after `last`."""
        if (
            message.following is not last.following
            or message.degree != last.degree
            or message.doubt != last.doubt
            or message.own != last.own
        ):
            return True
        if message.obeys != last.obeys and self._forecast.rests_off(last, message) > ROLL_ERROR:
            return True
        expected = self._expected(last, message.time_ns)
        x, y = expected.position
        vx, vy = expected.velocity
        off = hypot(message.x - x, message.y - y) + LOOKAHEAD_S * hypot(message.vx - vx, message.vy - vy)
        if off > self._bound_m:
            return True
        if not message.following:
            return False
        nx, ny = expected.navigation
        cx, cy = expected.constraint
        of_constraint = hypot(message.constraint_x - cx, message.constraint_y - cy)
        of_rest = hypot(
            message.navigation_x + message.correction_x - nx, message.navigation_y + message.correction_y - ny
        )
        by_force = 0.5 * LOOKAHEAD_S * LOOKAHEAD_S
        off += by_force * (of_constraint + of_rest)
        if off > self._bound_m:
            return True
        if message.multipliers == last.multipliers:
            return False
        before, slopes = dict(last.multipliers), self._slopes()
        for robot, value in message.multipliers:
            known = before.pop(robot, None)
            if known is None or by_force * slopes.get(robot, 0.0) * abs(value - known) > self._bound_m:
                return True
        return bool(before)

    def _expected(self, last: HandState, time_ns: int) -> Prediction:
        """What its neighbours take the robot for at a time, who have `last`."""
        if not self._predicts:
            return as_it_came(last)
        found = self._forecast.following(last, time_ns) if last.following else None
        return coasting(last, (time_ns - last.time_ns) / NS_PER_S) if found is None else found


def _is_news(told: dict[int, int], heard: tuple[tuple[int, int], ...]) -> bool:
    return any(robot not in told or told[robot] - delay_us > HEARD_OFF_US for robot, delay_us in heard)
