"""Whom a robot does not hear though others do, so that its link to it is opened anew (PURE).

Whatever keeps messages from coming over a link that stands: it counts what the bus delivered, before links
that fail on purpose, so that no fault rule looks like it. Of a process that has ended, is frozen or cannot be
reached the token goes with its link, and others do not hear it either.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import Beacon

LOOK_NS: Final = NS_PER_S // 2
SILENT_NS: Final = NS_PER_S
"""For so long no hand state has come from a robot whose beacons do, or for twice as long as it may take."""
LATE_NS: Final = NS_PER_S // 2
"""Others may be so much longer in saying that they do not hear a robot either."""
SURE_NS: Final = NS_PER_S
"""Where beacons are seldom it must seem for so long that others hear a robot: of one whose process stood they
may have heard one just now, and its next one comes here."""
PAUSE_NS: Final = 2 * NS_PER_S
PAUSE_MAX_NS: Final = 60 * NS_PER_S
"""A link that was opened anew, and did not help, is so again after this, then after twice as long."""
_NEVER: Final = -1


class _Other:
    """One other robot.

    Attributes:
        token_ns: since when its agent's process is there, -1 while it is not.
        came_ns, beacon_ns, hand_ns: when anything, a beacon, a hand state came of it last, -1 for never.
        listened_ns: since when its hand states are listened to, -1 while they are not.
        began_ns, told_ns: stamps of its first beacon since it is there, and of its latest.
        unheard: whom it said then that it does not hear.
        lacked_ns: since when it seems that others hear it, -1 while it does not.
    """

    __slots__ = (
        "beacon_ns", "began_ns", "came_ns", "due_ns", "hand_ns", "lacked_ns", "listened_ns", "pause_ns",
        "token_ns", "told_ns", "unheard",
    )  # fmt: skip

    def __init__(self) -> None:
        self.token_ns = self.came_ns = self.beacon_ns = self.hand_ns = _NEVER
        self.listened_ns = self.began_ns = self.told_ns = self.lacked_ns = _NEVER
        self.unheard: tuple[int, ...] = ()
        self.due_ns, self.pause_ns = 0, PAUSE_NS


class Deafness:
    """What one robot hears of the others.

    Args:
        robots: their ids.
        horizon_ns: who was not heard for so long is said to be not heard.
        hands_ns: within so long one robot sends two hand states.
        seldom_ns: so much longer than those of who has something to tell beacons may be apart.
        sees_all: whether `present` is told of all of them; else it is taken that they are there, for those
            that are not, nobody hears.
        one_link: all come over the same, from a router: it may be that which nothing comes over.
    """

    def __init__(
        self,
        robots: Iterable[int],
        horizon_ns: int,
        hands_ns: int = 0,
        *,
        seldom_ns: int = 0,
        sees_all: bool = True,
        one_link: bool = False,
    ) -> None:
        self._others = {robot: _Other() for robot in robots}
        if not sees_all:
            for other in self._others.values():
                other.token_ns = 0
        self._heard_after_ns = horizon_ns + seldom_ns + LATE_NS
        self._sure_after_ns = min(SURE_NS, seldom_ns)
        self._no_hands_ns = max(SILENT_NS, 2 * hands_ns)
        self._now_ns = self._due_ns = 0
        self._listened: Collection[int] = ()
        self._link = _Other() if one_link else None

    def came(self, robot: int, now_ns: int, *, hand: bool) -> None:
        """The bus delivered a hand state, or a beacon, on the key of a robot."""
        other = self._others[robot]
        other.came_ns = now_ns
        if hand:
            other.hand_ns = now_ns
        else:
            other.beacon_ns = now_ns

    def present(self, robot: int, here: bool) -> None:
        """The process of a robot's agent came or went."""
        other = self._others.get(robot)
        if other is not None:
            other.token_ns = self._now_ns if here else _NEVER
            other.began_ns = _NEVER

    def listens(self, robots: Collection[int], now_ns: int) -> None:
        """From now on the hand states of these robots are listened to, and of no others. Not asked for at
        looks: who comes near and goes again, and is near at each look, is not listened to all the time."""
        for robot, other in self._others.items():
            if robot not in robots:
                other.listened_ns = _NEVER
            elif other.listened_ns == _NEVER:
                other.listened_ns = now_ns
        self._listened = robots

    def told(self, beacon: Beacon) -> None:
        """Takes a beacon: whom its sender does not hear."""
        sender = self._others[beacon.robot]
        if sender.began_ns == _NEVER:
            sender.began_ns = beacon.time_ns
        sender.told_ns, sender.unheard = beacon.time_ns, beacon.unheard

    def look(self, now_ns: int) -> list[int]:
        """Robots whose links are to be opened anew now; looks twice a second."""
        if self._now_ns == 0:  # it begins
            for other in self._others.values():
                if other.listened_ns != _NEVER:
                    other.listened_ns = now_ns
        self._now_ns = now_ns
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + LOOK_NS
        found = []
        for robot, other in self._others.items():
            if other.token_ns == _NEVER:
                continue
            lacks = self._lacks_all(robot, other, now_ns) or _lacks_hands(other, now_ns, self._no_hands_ns)
            if _is_to_open(other, now_ns, lacks=lacks):
                found.append(robot)
        if self._link is not None and not found:
            there = self._unheard_from_all(now_ns)
            if _is_to_open(self._link, now_ns, lacks=bool(there)):
                found.append(there[0])
        return found

    def _unheard_from_all(self, now_ns: int) -> list[int]:
        """Who is seen to be there of those that are listened to, while nothing comes from anybody."""
        after_ns = now_ns - self._heard_after_ns
        if any(other.came_ns >= after_ns for other in self._others.values()):
            return []
        listened = (robot for robot in sorted(self._listened) if robot in self._others)
        there = ((robot, self._others[robot].token_ns) for robot in listened)
        return [robot for robot, token_ns in there if 0 < token_ns < after_ns]

    def _lacks_all(self, robot: int, other: _Other, now_ns: int) -> bool:
        """Whether nothing comes, and another robot that has been there as long goes on hearing it: so late
        that it must know."""
        since_ns = max(other.came_ns, other.token_ns)
        if now_ns - since_ns <= self._heard_after_ns or not any(
            each.told_ns - max(since_ns, each.began_ns) > self._heard_after_ns
            and each.began_ns != _NEVER
            and robot not in each.unheard
            for each in self._others.values()
            if each is not other
        ):
            other.lacked_ns = _NEVER
            return False
        if other.lacked_ns == _NEVER:
            other.lacked_ns = now_ns
        return now_ns - other.lacked_ns >= self._sure_after_ns


def _is_to_open(other: _Other, now_ns: int, *, lacks: bool) -> bool:
    """Whether a link over which something does not come is to be opened anew now."""
    if not lacks:
        if now_ns - other.due_ns > PAUSE_MAX_NS:
            other.pause_ns = PAUSE_NS
        return False
    if now_ns < other.due_ns:
        return False
    other.due_ns = now_ns + other.pause_ns
    other.pause_ns = min(2 * other.pause_ns, PAUSE_MAX_NS)
    return True


def _lacks_hands(other: _Other, now_ns: int, silent_ns: int) -> bool:
    """Whether only beacons come: who says where it is says it to its neighbours as well."""
    since_ns = max(other.hand_ns, other.listened_ns, other.token_ns)
    heard = other.listened_ns != _NEVER and now_ns - other.beacon_ns < SILENT_NS
    return heard and other.beacon_ns - since_ns > silent_ns and now_ns - since_ns > silent_ns
