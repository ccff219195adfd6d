"""Which robots may be silent: the others need not be looked at one by one, however many there are (PURE).

Of each robot it is kept from when on it may be, at the soonest. What comes of it mostly puts that off, and it
is asked for again only once that time has come; what may bring it forward is noted at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heappush
from typing import Final

from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import SINCE_EVER, Peer


class Overdue:
    """The robots that may be silent, of all that something is known of.

    Args:
        known: these by their ids; it may grow, by such as are added.
        within_ns: whoever is late by less is in time; `UNSURE_NS` at most.
    """

    def __init__(self, known: Mapping[int, Peer], within_ns: int = UNSURE_NS) -> None:
        self._known = known
        self._within_ns: Final = min(within_ns, UNSURE_NS)
        self._queue: list[tuple[int, int]] = []
        """(`Peer.overdue_ns`, robot), the next one first; others of a robot do not count."""
        self._late = set(known)

    def add(self, peer: Peer) -> None:
        """From now on something is known of a robot."""
        self._late.add(peer.robot)

    def note(self, peer: Peer) -> None:
        """Something has come of a robot, or of its presence, that may have it be silent sooner: less is
        forgiven it than before, its clock is found to be further ahead, it does not hear this robot, or there
        is no connection to it."""
        from_ns = self._overdue_from_ns(peer)
        if from_ns < peer.overdue_ns:
            self._await(peer, from_ns)

    def at(self, now_ns: int) -> list[Peer]:
        """Those that may be silent, in the order in which they came to be known: with no connection, never
        heard, late by `within_ns` or more as far as they are heard themselves, or such that say that they do
        not hear this robot."""
        known, queue, late = self._known, self._queue, self._late
        if late:
            for robot in tuple(late):
                peer = known[robot]
                from_ns = self._overdue_from_ns(peer)
                if from_ns > now_ns:
                    late.remove(robot)
                    self._await(peer, from_ns)
        while queue and queue[0][0] <= now_ns:
            before_ns, robot = heappop(queue)
            peer = known[robot]
            if robot in late or peer.overdue_ns != before_ns:
                continue
            from_ns = self._overdue_from_ns(peer)
            if from_ns > now_ns:
                self._await(peer, from_ns)
            else:
                peer.overdue_ns = SINCE_EVER
                late.add(robot)
        return [peer for robot, peer in known.items() if robot in late] if late else []

    def _await(self, peer: Peer, from_ns: int) -> None:
        peer.overdue_ns = from_ns
        heappush(self._queue, (from_ns, peer.robot))

    def _overdue_from_ns(self, peer: Peer) -> int:
        """From when on a robot may be silent, by the own clock, if nothing more comes of it."""
        if peer.deaf or not peer.here or peer.message is None:
            return SINCE_EVER
        return peer.direct_ns - peer.clock.used_ns + peer.lateness.forgiven_ns + self._within_ns
