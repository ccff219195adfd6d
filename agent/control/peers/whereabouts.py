"""Where robots may be that are not heard."""

from __future__ import annotations

from collections.abc import Mapping

from handfast.agent.common.quantities import Vector
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.beliefs import Belief, stands_after, stood_between
from handfast.agent.control.peers.forecast import Forecast
from handfast.agent.control.peers.peer import Peer
from handfast.agent.messages.types import HandState


class Whereabouts:
    """Works out, once for each last message of a robot, where it may have gone since.

    Args:
        forecast: how all of them move.
        starts: where the hands of all others are until they are heard, m, W.
        horizon_s: a robot that hears nobody for so long stands.
    """

    def __init__(self, forecast: Forecast, starts: Mapping[int, Vector], horizon_s: float) -> None:
        self._forecast, self._starts, self._horizon_s = forecast, starts, horizon_s
        self._beliefs: dict[int, tuple[HandState, Belief]] = {}
        self._strangers: dict[int, HandState] = {}
        self._at_starts: dict[int, Belief] = {}

    def belief(self, peer: Peer) -> Belief | None:
        """Where a robot may be that is not heard; None for one whose body has been carried off, or of which
        nothing is known."""
        message, robot = peer.message, peer.robot
        if peer.is_gone:
            return None
        if message is None:
            unheard = self._at_starts.get(robot)
            if unheard is None and (start := self._starts.get(robot)) is not None:
                unheard = self._at_starts[robot] = stood_between(*start, *start, 0.0)
            return unheard
        if peer.belief is not None:
            return peer.belief
        known = self._beliefs.get(robot)
        if known is None or known[0] is not message:
            known = self._beliefs[robot] = (
                message,
                self._forecast.stood(
                    message, stands_after(self._horizon_s, peer.lateness.forgiven_ns / NS_PER_S)
                ),
            )
        return known[1]

    def is_worked_out(self, peer: Peer) -> bool:
        """Whether `belief` knows already where a robot may be."""
        known = self._beliefs.get(peer.robot)
        if peer.message is None or peer.belief is not None or peer.is_gone:
            return True
        return known is not None and known[0] is peer.message

    def last_of(self, peer: Peer) -> HandState:
        """What is known last of a robot; of one that was never heard, that it stands where it starts."""
        if peer.message is not None:
            return peer.message
        at = *self._starts[peer.robot], 0.0, 0.0
        stranger = HandState.placed(peer.robot, 0, 0, True, 0, at)
        return self._strangers.setdefault(peer.robot, stranger)
