"""Whether the own loop keeps its rate, and how far that of the fleet falls where somebody's does not (PURE).

A loop that runs late says so in its robot's beacons: by how many steps it wants the rate to fall. Every robot
goes by the greatest that it has heard of late, itself included, from the robots themselves: nobody passes it
on, so that nobody hears his own wish back. In step s a period is 2^s times as long (`agent.control.limits`);
beyond the last step the rate stays, and robots drive more slowly still. Where even then the gaps between
decisions are longer than the law and the bodies carry, all stand.

It also says how much of a time this process did not run: what was not heard meanwhile was not silent.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from operator import itemgetter
from typing import Final

from handfast.agent.common.time import NS_PER_MS, NS_PER_S

WINDOW_NS: Final = NS_PER_S
WINDOW_PERIODS: Final = 20
"""It is counted how many ticks were late in the last second, or so many periods if that is longer."""
LATE_SHARE: Final = 0.1
LATE_SHARE_AT_REST: Final = 0.5
LATE_LEAST: Final = 3
"""So large a share of them, while the robot drives and while it does not, and so many at least, are too many:
one hitch is none. As many gaps between decisions that are too long are too many to drive on at all."""
CALM_NS: Final = 3 * NS_PER_S // 2
CALM_PERIODS: Final = 12
CALM_MAX_NS: Final = 60 * NS_PER_S
"""After so long, and so many periods, in which it would have kept the next higher rate it wants that again.
Where it then cannot, it waits twice as long the next time, up to the last of these."""
RELAPSE_NS: Final = 5 * NS_PER_S
"""A rate that was kept for longer than this, and the time that was waited for it, did not come too soon."""
CALM_SHARE: Final = 0.02
"""So large a share of ticks may be late in a time that counts as calm, and one."""
HEARD_NS: Final = 2 * NS_PER_S
"""What a robot wants holds for so long after its last beacon was due."""
STALLS_MAX: Final = 256
TIGHT_MAX: Final = 2048
"""So many late ticks, at least and at most, are remembered: to tell of them, and to know if it is calm."""
SAID_NS: Final = 5 * NS_PER_S
"""Texts name the latest of the ticks since then."""
_END: Final = itemgetter(0)


class Overload:
    """What one robot wants, and what it goes by.

    Told of late ticks alone, it costs nothing while there are none.

    Args:
        steps: so many times the period may double (`agent.control.limits.steps`).
        period_ns: of the full rate.
        gap_ns: what drives on for longer without a decision is out of control.
        standing_ns: the period while all stand for it (`agent.control.limits.standing_period_ns`).

    Attributes:
        idle: whether there is nothing to look at.
        wanted: by how many steps this robot wants the rate to fall, 0..steps + 2: slower still, and stands.
        level: the greatest that anybody wants; others: that others want.
        late_ticks: how many of its own ticks began too late, since the start.
        stood_ns: for how long its loop stood, since the start: by a period or more at a time.
    """

    def __init__(self, steps: int, period_ns: int, gap_ns: int, standing_ns: int = 0) -> None:
        self._steps, self._full_ns, self._gap_ns = steps, period_ns, gap_ns
        self._standing_ns = standing_ns
        self.idle = True
        self.wanted = self.level = self.others = 0
        self.late_ticks = self.stood_ns = 0
        self._drives = True
        self._stalls: list[tuple[int, int, int]] = []
        self._missed_ns = 0
        self._late: deque[int] = deque()
        self._gaps: deque[int] = deque()
        self._tight: deque[int] = deque(maxlen=TIGHT_MAX)
        self._others: dict[int, tuple[int, int]] = {}
        self._blamed: list[int] = []
        """Who wants the level that is gone by; they may have said something else since."""
        self._since_ns = 0
        self._fell_ns: int | None = None
        self._looked_ns = self._asked_ns = 0
        self._spent_ns: dict[int, int] = {}
        self._patience_ns = CALM_NS

    @property
    def step(self) -> int:
        """By how many steps the rate has fallen."""
        return min(self.level, self._steps)

    @property
    def stands(self) -> bool:
        """Whether it must not drive."""
        return self.level > self._steps + 1

    @property
    def period_ns(self) -> int:
        """The period now."""
        period_ns = self._full_ns << self.step
        return max(period_ns, self._standing_ns) if self.stands else period_ns

    @property
    def _calm_ns(self) -> int:
        """So long it must be calm until it wants a higher rate again: few ticks in time say little."""
        return max(self._patience_ns, CALM_PERIODS * self.period_ns)

    def late(self, now_ns: int, late_ns: int) -> None:
        """Takes that the tick at `now_ns` begins so much after its deadline."""
        self.idle = False
        self._missed_ns += late_ns
        if late_ns >= self.period_ns:
            self.stood_ns += late_ns
        self._stalls.append((now_ns, late_ns, self._missed_ns))
        if len(self._stalls) > 2 * STALLS_MAX:
            del self._stalls[:STALLS_MAX]
        too_late = 2 * late_ns > self.period_ns
        # At the next higher rate, where the period is shorter, it would be.
        next_ns = self._full_ns << self._steps if self.stands else self.period_ns // 2
        would_be = 2 * late_ns > next_ns and self.level and self.level != self._steps + 1
        if too_late:
            self._late.append(now_ns)
            self.late_ticks += 1
            if self.period_ns + late_ns > self._gap_ns:
                self._gaps.append(now_ns)
        if too_late or would_be:
            self._tight.append(now_ns)

    def heard(self, robot: int, wanted: int, now_ns: int, next_ns: int) -> None:
        """Takes what another robot wants, whose next beacon is due `next_ns` later."""
        if wanted > 0:
            self.idle = False
            self._others[robot] = wanted, now_ns + next_ns + HEARD_NS
        else:
            self._others.pop(robot, None)

    def is_wanted_by(self, robot: int) -> bool:
        """Whether a robot said of late that its own process does not keep its rate."""
        return robot in self._others

    def look(self, now_ns: int, *, drives: bool = True) -> bool:
        """Finds what to go by at a tick; whether that is another level than before.

        While the robot does not drive, as when all processes of a machine start, more may be late.
        """
        if drives is not self._drives:
            self._drives = drives
            self._late.clear()
            self._gaps.clear()
        window_ns = max(WINDOW_NS, WINDOW_PERIODS * self.period_ns)
        for ticks in (self._late, self._gaps):
            while ticks and ticks[0] <= now_ns - window_ns:
                ticks.popleft()
        share = LATE_SHARE if drives else LATE_SHARE_AT_REST
        if len(self._late) >= max(LATE_LEAST, share * window_ns / self.period_ns):
            self._rise(now_ns, self._steps + (2 if len(self._gaps) >= LATE_LEAST else 1))
        elif self.wanted and self.wanted >= self.level and now_ns - self._since_ns >= self._calm_ns:
            self._fall(now_ns)
        self.others = self._asked_by_others(now_ns)
        before = self.level
        if before:
            self._spent_ns[before] = self._spent_ns.get(before, 0) + now_ns - self._looked_ns
            self._asked_ns += now_ns - self._looked_ns if self.wanted else 0
        self._looked_ns = now_ns
        self.level = min(max(self.wanted, self.others), self._steps + 2)
        self._blamed = sorted(robot for robot, (wanted, _) in self._others.items() if wanted >= self.level)
        self.idle = not (self.wanted or self._others or self._late)
        if self.level != before:
            self._forget(now_ns)
        return self.level != before

    def _asked_by_others(self, now_ns: int) -> int:
        """Return the level that the other robots' requests amount to, without those that have expired."""
        for robot, (_, until_ns) in tuple(self._others.items()):
            if now_ns > until_ns:
                del self._others[robot]
        most, second = sorted((0, 0, *(wanted for wanted, _ in self._others.values())))[:-3:-1]
        # A single faulty robot may slow the fleet down, but must not stop it: that takes two.
        return most if second > self._steps + 1 else min(most, self._steps + 1)

    def _rise(self, now_ns: int, top: int) -> None:
        """It does not keep the rate that it has; no further than to `top`."""
        if self.wanted <= self.level < top:
            if self._fell_ns is not None and now_ns - self._fell_ns < self._patience_ns + RELAPSE_NS:
                self._patience_ns = min(2 * self._patience_ns, CALM_MAX_NS)
            elif self.wanted == 0:
                self._patience_ns = CALM_NS
            self._fell_ns = None
            self.wanted = self.level + 1
        self._forget(now_ns)

    def _fall(self, now_ns: int) -> None:
        """Wants the next higher rate again, if it would have kept it for long enough."""
        calm_ns = self._calm_ns
        while self._tight and self._tight[0] <= now_ns - calm_ns:
            self._tight.popleft()
        if len(self._tight) <= 1 + CALM_SHARE * calm_ns / self.period_ns:
            self.wanted -= 1
            self._fell_ns = now_ns
            self._forget(now_ns)

    def _forget(self, now_ns: int) -> None:
        """Begins to count anew."""
        self._since_ns = now_ns
        self._late.clear()
        self._gaps.clear()
        self._tight.clear()

    # ------------------------------------------------------------------ what it has not heard for that

    def missed_ns(self, since_ns: int) -> int:
        """For how much of the time since then this process did not run, though it should have."""
        first = bisect_right(self._stalls, since_ns, key=_END)
        if first == len(self._stalls):
            return 0
        end_ns, late_ns, missed_ns = self._stalls[first]
        return self._missed_ns - missed_ns + min(late_ns, end_ns - since_ns)

    # ------------------------------------------------------------------ to tell

    def counters(self) -> dict[str, int]:
        """What a status counts of it; nothing where it never stood and the rate never fell."""
        stood = {"stood_ms": self.stood_ns // NS_PER_MS} if self.stood_ns else {}
        if not self._spent_ns:
            return stood
        spent = {
            f"overload.level_{level}_ms": ns // NS_PER_MS for level, ns in sorted(self._spent_ns.items())
        }
        asked_ms = self._asked_ns // NS_PER_MS
        return {**stood, "overload.late": self.late_ticks, "overload.asked_ms": asked_ms, **spent}

    def stall(self, now_ns: int) -> str:
        """Why this robot does not know what it should: its own process stood."""
        lately = self._stalls[bisect_right(self._stalls, now_ns - SAID_NS, key=_END) :]
        worst_ns = max((late_ns for _, late_ns, _ in lately), default=0)
        return "overloaded: this machine ran late" + (f" by {worst_ns / NS_PER_S:.2g} s" if worst_ns else "")

    def text(self, now_ns: int) -> str:
        """Why the robot drives as it does, "" at the full rate."""
        if not self.level:
            return ""
        if self.wanted >= self.level:
            why = self.stall(now_ns)
        else:
            who = self._blamed
            more = f" and {len(who) - 1} more" if len(who) > 1 else ""
            why = f"overloaded: the machine of robot {who[0]}{more} runs late"
        rate = f"{NS_PER_S / self.period_ns:.4g} Hz" if self.step else ""
        slower = "slower still" if rate and self.level > self._steps else "" if rate else "slower"
        if self.stands:
            slower = "stands until it does not"
        return f"{why}: {', '.join(filter(None, (rate, slower)))}"
