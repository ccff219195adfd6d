"""Which vehicles roll on, of those that one robot does not hear (PURE). See (S3) of docs/theory.md."""

from __future__ import annotations

from collections.abc import Mapping

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.dodging import STEP_S
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import NEVER, Peer


class LostVehicles:
    """Vehicles that nothing commands, as far as one robot can tell.

    Whoever hears nobody is most likely the one to whom nothing comes, and the others are commanded; but of
    those that were lost before he knows it. Where all fell silent at once, any of them may be lost.

    Args:
        known: the other robots by their ids; it may grow.
    """

    def __init__(self, known: Mapping[int, Peer], forecast: Forecast) -> None:
        self._known, self._forecast = known, forecast
        self._sure: frozenset[int] = frozenset()
        self._looked_ns = NEVER

    def may_roll(self, peer: Peer, now_ns: int) -> bool:
        """Whether the body of a robot may go on now, as nothing commands it."""
        if not peer.rolls_on or peer.is_gone or (peer.is_heard(now_ns) and not peer.is_astray):
            return False
        return self.hand(peer, now_ns) is not None

    def is_sure(self, peer: Peer, now_ns: int) -> bool:
        """Whether a robot that is not heard is known to be lost, and its body to go on."""
        if self._looked_ns != now_ns:
            self._looked_ns = now_ns
            known = self._known.values()
            latest_ns = max(each.direct_ns - each.clock.used_ns for each in known)
            self._sure = frozenset(each.robot for each in known if self._is_lost(each, now_ns, latest_ns))
        return peer.robot in self._sure

    def hand(self, peer: Peer, now_ns: int) -> Hand | None:
        """Where the hand of a robot that is not heard is (m, m/s, W) if nothing commands its body; None where
        it stands by then, or others are the lost ones."""
        if not self.is_sure(peer, now_ns) and self._sure:
            return None
        return self._rolled(peer, now_ns)

    def way(self, peer: Peer, now_ns: int) -> list[Vector]:
        """Where the hand of a robot is every `STEP_S` from now on, until it rests, m, W, if nothing commands
        its body."""
        went = peer.went
        if went is None:
            return []
        age = (now_ns + peer.clock.used_ns - went.time_ns) / NS_PER_S
        return self._forecast.rolling_on(went, age, STEP_S)

    def _rolled(self, peer: Peer, now_ns: int) -> Hand | None:
        went = peer.went
        if went is None:
            return None
        return self._forecast.rolling(went, (now_ns + peer.clock.used_ns - went.time_ns) / NS_PER_S)

    def _is_lost(self, peer: Peer, now_ns: int, latest_ns: int) -> bool:
        """Whether it has said so, or was missed before `latest_ns`, when the last of all was heard."""
        message = peer.message
        if message is None or peer.is_gone or (peer.is_heard(now_ns) and not peer.is_astray):
            return False
        if self._rolled(peer, now_ns) is None:
            return False
        missed_ns = peer.direct_ns - peer.clock.used_ns + peer.lateness.forgiven_ns + UNSURE_NS
        return not message.obeys or peer.is_astray or missed_ns < latest_ns
