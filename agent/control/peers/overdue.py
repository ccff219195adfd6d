"""Which robots may be silent: the others need not be looked at one by one, however many there are (PURE).

Of each robot it is kept from when on it may be, at the soonest. What comes of it mostly puts that off, and it
is asked for again only once that time has come; what may bring it forward is noted at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heappush
from typing import Final

from agent.control.peers.lateness import UNSURE_NS
from agent.control.peers.peer import Peer

_SINCE_EVER: Final = -(1 << 62)


class Overdue:
    """The robots that may be silent, of all that something is known of.

    Args:
        known: these by their ids; it may grow, by such as are noted.
        within_ns: whoever is late by less is in time; `UNSURE_NS` at most.
    """

    def __init__(self, known: Mapping[int, Peer], within_ns: int = UNSURE_NS) -> None:
        self._known = known
        self._within_ns: Final = min(within_ns, UNSURE_NS)
        self._from_ns: dict[int, int] = {}
        """By robot that was in time: from when on it may not be, own clock, or sooner than that."""
        self._queue: list[tuple[int, int]] = []
        """The same as (time ns, robot), the next one first; what is not in `_from_ns` does not count."""
        self._late = set(known)

    def note(self, peer: Peer) -> None:
        """Something has come of a robot, or of its presence, that may have it be silent sooner."""
        robot = peer.robot
        if robot in self._late:
            return
        before_ns = self._from_ns.get(robot)
        from_ns = self._overdue_from_ns(peer)
        if before_ns is None or from_ns < before_ns:
            self._await(robot, from_ns)

    def at(self, now_ns: int) -> list[Peer]:
        """Those that may be silent, in the order in which they came to be known: with no connection, never
        heard, late by `within_ns` or more as far as they are heard themselves, or such that say that they do
        not hear this robot."""
        known, queue, late = self._known, self._queue, self._late
        if late:
            for robot in tuple(late):
                from_ns = self._overdue_from_ns(known[robot])
                if from_ns > now_ns:
                    late.remove(robot)
                    self._await(robot, from_ns)
        while queue and queue[0][0] <= now_ns:
            before_ns, robot = heappop(queue)
            if self._from_ns.get(robot) != before_ns:
                continue
            from_ns = self._overdue_from_ns(known[robot])
            if from_ns > now_ns:
                self._await(robot, from_ns)
            else:
                del self._from_ns[robot]
                late.add(robot)
        return [peer for robot, peer in known.items() if robot in late] if late else []

    def _await(self, robot: int, from_ns: int) -> None:
        self._from_ns[robot] = from_ns
        heappush(self._queue, (from_ns, robot))

    def _overdue_from_ns(self, peer: Peer) -> int:
        """From when on a robot may be silent, by the own clock, if nothing more comes of it."""
        if peer.deaf or not peer.here or peer.message is None:
            return _SINCE_EVER
        return peer.direct_ns - peer.clock.used_ns + peer.lateness.forgiven_ns + self._within_ns
