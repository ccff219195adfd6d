"""How far a robot trusts its neighbours, and what it does about those that it cannot trust (PURE).

A neighbour's last state is carried forward as it grows old; from three quarters of
`control.prediction_horizon_s` on the robot drives slower, and from `control.prediction_horizon_s` on, or as
soon as the connection to its agent is lost, trust in that edge fades. So it does for a neighbour that is
heard but does not follow the law. The edge comes back as slowly as trust does. It keeps away from whom it
does not trust, too.
"""

from __future__ import annotations

from math import inf
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.peer import NEVER, Peer
from handfast.agent.control.peers.peers import TRUST_GAINED_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import SLOW_SHARE
from handfast.agent.formation.reference import Edge
from handfast.agent.supervision.overload import Overload
from handfast.agent.supervision.state_machine import DRIVING, State

SLOWEST: Final = 0.3
"""Share of its speed that a robot has left when it gives a neighbour up."""
LINK_LOST_NS: Final = 4 * NS_PER_S
"""A link that is lost so soon after the own process has stood for long was lost by that."""
BEGUN: Final = 0.01
"""An edge that weighs less is not missed: who has just joined is not heard yet."""


class _Found:
    """What one tick finds about all edges of a robot.

    Attributes:
        ages_us: ages of the neighbours' hand states that are known.
        share: share of its speed that the robot has to keep to.
        slow, given_up: neighbours that it slows down for or cannot rely on, with the reasons.
        newer: why it waits for a newer mission, "" if it does not.
        begun: edges that count.
        silent: of these, to neighbours that are not heard or do not hear this robot. unasked: of these, to
            neighbours that it did not hear because its own process did not run.
        untold: to neighbours that have not said yet which robots they hear.
    """

    def __init__(self) -> None:
        self.ages_us: list[int] = []
        self.share = 1.0
        self.slow: list[str] = []
        self.given_up: list[str] = []
        self.newer = ""
        self.begun = self.silent = self.unasked = self.untold = 0


class NeighbourTrust:
    """Judges the edges of one robot, tick by tick.

    Args:
        overload: of its own process.

    Attributes:
        period_s: of a tick.
        slower: share of its speed that the robot has to keep to, 1 when all is well.
        hold: why it must not drive, "" when it may.
        degraded: why it drives other than the law says, "" when it does not.
        changed: True when other robots are to be listened to; whoever does that sets it back.
    """

    def __init__(self, fleet: Fleet, controller: Controller, overload: Overload) -> None:
        self._controller, self._overload = controller, overload
        self.period_s = fleet.period_ns / NS_PER_S
        self._horizon_ns = round(fleet.control.prediction_horizon_s * NS_PER_S)
        self._slow_ns = round(SLOW_SHARE * fleet.control.prediction_horizon_s * NS_PER_S)
        self._all_needed = fleet.supervision.silence == "hold"
        self._edges: object = None
        self._drove_ns = -1
        self._held = False
        self.slower = 1.0
        self.hold = self.degraded = ""
        self.changed = True

    def update(self, now_ns: int, state: State, here: Hand | None) -> list[int]:
        """Judge all edges at a tick; return the ages (us) of the neighbours' hand states that are known.

        Args:
            state: state of the robot before this tick.
            here: hand of the robot, None when it is not known.
        """
        controller, drives = self._controller, state in DRIVING
        stands = self._held and not drives
        self._listen(now_ns, here, held=stands)
        if drives:
            self._drove_ns = now_ns
        found = _Found()
        for edge, peer in controller.edges:
            self._judge(found, edge, peer, now_ns, state)
        # It slows down as it has to, and comes back to its speed as slowly as trust does.
        self.slower = min(found.share, self.slower + self.period_s / TRUST_GAINED_S) if drives else 1.0
        self._conclude(found, now_ns)
        self._add_causes(now_ns, here, drives=drives, stands=stands)
        return found.ages_us

    def _add_causes(self, now_ns: int, here: Hand | None, *, drives: bool, stands: bool) -> None:
        """Add to `hold` and `degraded` what has other causes than the edges."""
        controller = self._controller
        held = controller.evades or controller.taken or controller.detour.held
        if drives and held:
            self.degraded = "; ".join(filter(None, (self.degraded, held)))
        if self._overload.stands:
            self.hold = self._overload.text(now_ns)
        self._held = bool(self.hold)
        self.hold = self.hold or controller.right_of_way.hold
        if stands and controller.rests:
            self.hold = self.hold or "finds out who may be near"
        if here is not None and controller.proximity.fence is not None:
            self._look_at_fence(here)

    def _listen(self, now_ns: int, here: Hand | None, *, held: bool) -> None:
        """Set `changed` if the robot has other neighbours, or other robots nearby, than before."""
        controller = self._controller
        if controller.edges is not self._edges:
            self._edges = controller.edges
            self._neighbours = {peer.robot for _, peer in controller.edges}
            self.changed = True
        if here is not None and controller.look_round(now_ns, here, self._neighbours, held=held):
            self.changed = True

    def _judge(self, found: _Found, edge: Edge, peer: Peer, now_ns: int, state: State) -> None:
        """Update the trust in a neighbour, and add what is to be said of the edge to `found`."""
        late = self._late_ns(found, peer, now_ns)
        heard = late <= self._horizon_ns and peer.here
        message = peer.message
        wanted = heard and message is not None and message.following
        self._update_trust(peer, state, wanted=wanted)
        if edge.weight < BEGUN:
            return
        found.begun += 1
        is_named = False
        if not heard or peer.deaf:
            found.silent += 1
            found.unasked += not heard and self._is_own_doing(peer, now_ns)
        elif state is State.HOLDING:
            is_named = self._wait_for(found, peer, now_ns)
        if wanted and not peer.deaf:
            if late > self._slow_ns:
                gone = (late - self._slow_ns) / (self._horizon_ns - self._slow_ns)
                found.share = min(found.share, 1.0 - (1.0 - SLOWEST) * gone)
                found.slow.append(self._why(peer, now_ns, heard=False))
        elif not is_named and (wanted or edge.weight >= 1.0):  # else it leaves, or has only just joined
            found.given_up.append(self._why(peer, now_ns, heard=heard))

    def _late_ns(self, found: _Found, peer: Peer, now_ns: int) -> float:
        """Return how late a neighbour's next hand state is, and add the age of its last one to `found`."""
        age = peer.age_ns(now_ns)
        if age is not None:
            found.ages_us.append(age // 1000)
        if peer.hand_next_ns:
            return peer.promised_late_ns(now_ns)
        return inf if age is None else age - peer.lateness.forgiven_ns

    def _update_trust(self, peer: Peer, state: State, *, wanted: bool) -> None:
        if state not in DRIVING:
            self._controller.peers.set_trust(peer, 1.0 if wanted and state is State.READY else 0.0)
        elif not wanted or peer.trust != 1.0:  # nearly always it is trusted
            self._controller.peers.update_trust(peer, wanted, self.period_s)

    def _wait_for(self, found: _Found, peer: Peer, now_ns: int) -> bool:
        """Look at a neighbour that is heard while the robot holds; return True if it has been named."""
        if not peer.has_told(now_ns, self._horizon_ns):
            found.untold += 1
            found.given_up.append(f"{peer.name} (has not said yet whom it hears)")
            return True
        mark = peer.mark
        if mark > self._controller.mark:
            found.newer = found.newer or f"waits for mission {mark[0]}, which {peer.name} has"
        return False

    def _conclude(self, found: _Found, now_ns: int) -> None:
        """Set `hold` and `degraded` by what was found about all edges."""
        self.hold = self.degraded = ""
        none = found.begun > 0 and found.silent + found.untold == found.begun
        none = none and (found.untold > 0 or not self._hears_others(now_ns))
        if none or (found.silent and self._all_needed):
            if found.unasked and found.unasked == found.silent:  # it may hear them when it looks again
                self.hold = self._overload.stall(now_ns)
            else:
                number = "not all" if found.silent < found.begun else "none"
                self.hold = f"hears {number} of its neighbours: {', '.join(found.given_up)}"
        elif found.newer:  # it does not begin to drive by a mission that those it hears have left
            self.hold = found.newer
        elif found.given_up:
            self.degraded = f"without {', '.join(found.given_up)}"
        elif found.slow:
            self.degraded = f"slower: {', '.join(found.slow)}"

    def _hears_others(self, now_ns: int) -> bool:
        """Return True if some robot, neighbour or not, hears this one and is heard by it."""
        return any(
            peer.here
            and not peer.deaf
            and peer.direct_ns != NEVER
            and peer.direct_late_ns(now_ns) <= self._horizon_ns
            for peer in self._controller.peers.known
        )

    def missing(self, now_ns: int, *, started: bool) -> str:
        """Whom the robot lacks to begin, in words: anybody before the drive, all of them once it goes on."""
        if self._overload.stands:
            return self._overload.text(now_ns)
        edges = self._controller.edges
        silent = [
            self._why(peer, now_ns, heard=False)
            for _, peer in edges
            if (late := peer.hand_late_ns(now_ns)) is None
            or late > self._horizon_ns
            or not peer.here
            or peer.deaf
        ]
        others = len(silent) < len(edges) or self._hears_others(now_ns)
        if not silent or (started and not self._all_needed and others):
            return self._changed_since(now_ns) if started else ""
        return f"silent neighbours: {', '.join(silent)}"

    def _changed_since(self, now_ns: int) -> str:
        """Who has not been heard since the robot drove last, and is not given up yet.

        What stopped this one may have stopped those, too: what they said before is no ground to predict them.
        """
        known = [peer for _, peer in self._controller.edges] + list(self._controller.proximity.close)
        unheard = [
            self._why(peer, now_ns, heard=False)
            for peer in known
            if peer.message is not None
            and peer.time_ns - peer.clock.used_ns <= self._drove_ns
            and peer.late_ns(now_ns) <= self._horizon_ns
        ]
        return f"not heard since it stood: {', '.join(unheard)}" if unheard else ""

    def _look_at_fence(self, here: Hand) -> None:
        proximity = self._controller.proximity
        inside = proximity.fence_distance(here.x, here.y)
        if inside < 0.0:
            self.hold = self.hold or f"{-inside:.2f} m outside the geofence"
        elif inside < proximity.warn:
            self.degraded = self.degraded or f"{inside:.2f} m from the geofence"

    def _is_own_doing(self, peer: Peer, now_ns: int) -> bool:
        """Whether a robot that is not heard may have spoken all the time, or lost its link, while the own
        process did not run."""
        if not peer.here:
            return self._overload.missed_ns(now_ns - LINK_LOST_NS) > LINK_LOST_NS // 4
        missed_ns = self._overload.missed_ns(peer.hand_ns - peer.clock.used_ns)
        late_ns = (peer.age_ns(now_ns) or 0) - peer.lateness.forgiven_ns
        return late_ns - missed_ns <= self._horizon_ns < late_ns

    def _why(self, peer: Peer, now_ns: int, *, heard: bool) -> str:
        """A neighbour that cannot be relied on: its id, and why."""
        if peer.ahead_ns:
            return f"{peer.name} (its clock is {peer.ahead_ns / NS_PER_S:.2f} s ahead)"
        age, late = peer.age_ns(now_ns), peer.hand_late_ns(now_ns)
        if peer.deaf and late is not None and late <= self._horizon_ns:
            return f"{peer.name} (does not hear this one)"
        if heard:
            slow = self._overload.is_wanted_by(peer.robot)
            return f"{peer.name} (does not follow{', its machine runs late' if slow else ''})"
        if age is not None and self._is_own_doing(peer, now_ns):
            return f"{peer.name} ({self._overload.stall(now_ns)})"
        if peer.other_version and (age is None or age > self._horizon_ns):
            return f"{peer.name} (another handfast: {peer.other_version})"
        if age is None:
            return peer.name
        if not peer.here and age - peer.hand_next_ns <= self._horizon_ns:
            # A token that is lost tells no more: the agent has ended, is frozen, or is cut off.
            may_be_late = ", its machine may run late" if self._overload.level else ""
            return f"{peer.name} (no connection to its agent{may_be_late})"
        return f"{peer.name} ({age / NS_PER_S:.1f} s)"
