"""What one robot tells again of operators' orders, on its own key, and to whom (PURE).

An order is relayed byte by byte: its codec gives the bytes that came, and whoever made them vouches for them.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_choice import MissionChoice
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.sequence_numbers import SequenceNumbers
from handfast.agent.messages.types import Ask, Beacon, Mission, Outgoing, PlantState, Resume, Stop
from handfast.agent.messages.versions import can_be
from handfast.agent.supervision.gossip import AGAIN_NS, SPREAD_NS, Gossip
from handfast.agent.supervision.stop_latch import StopLatch

UNMOVED_NS: Final = NS_PER_S // 2
"""A plant that brakes for so long while it is asked to drive may have missed a resume."""


class OrderRelay:
    """What robot `robot` of `fleet` tells, of its latch's orders and the mission that it has chosen.

    Attributes:
        key: where it tells it.
        subscription: where all robots do.
    """

    def __init__(self, fleet: Fleet, robot: int, latch: StopLatch, missions: MissionChoice) -> None:
        name = fleet.fleet.name
        self.key: Final = key_expressions.relayed(name, robot)
        self.subscription: Final = key_expressions.relayed(name, "*")
        self._latch, self._choice = latch, missions
        step_ns = max(SPREAD_NS, fleet.period_ns) if fleet.is_large else SPREAD_NS
        self._missions = Gossip(robot, lambda: missions.mark, step_ns, is_shared=fleet.is_large)
        self._orders = Gossip(robot, lambda: latch.mark, step_ns, is_shared=fleet.is_large)
        self._numbers = SequenceNumbers(fleet.period_ns)
        """Those of the own plant, if it has acknowledged the mission."""
        self._plant_told_ns = -AGAIN_NS
        self._insisted_ns = 0

    # ------------------------------------------------------------------ what it hears

    def accept(self, order: Stop | Resume, now_ns: int) -> str | None:
        """Hands a stop or a resume to the latch; returns why it is refused, None when it is not."""
        latch = self._latch
        before = latch.mark
        if not can_be(order.version, now_ns):
            return latch.accept_ahead(order, now_ns)
        reason = latch.accept_stop(order) if isinstance(order, Stop) else latch.accept_resume(order)
        changed = latch.mark != before
        if order.version >= latch.version:
            self._orders.said(now_ns, latch.mark)
        if changed and isinstance(order, Stop):
            self._orders.insist()
        elif changed:  # who lacks a resume stands meanwhile
            self._orders.learnt(now_ns)
        return reason

    def recall(self, order: Stop | Resume) -> None:
        """This robot had taken that stop or resume before its process started again: others may lack it."""
        self._latch.recall(order)
        self._orders.insist()

    def heard(self, now_ns: int, mission: Mission) -> None:
        """Somebody has said a mission that is for this fleet, newer or not."""
        self._missions.said(now_ns, self._choice.mark_of(mission))

    def took(self, mission: Mission, now_ns: int) -> None:
        """This is the mission from now on. In a large fleet not all of them tell all of them."""
        self._numbers.begin(mission.epoch_ns)
        self._plant_told_ns = now_ns  # what it said last it said before
        self._missions.learnt(now_ns)

    def compare(self, now_ns: int, beacon: Beacon) -> None:
        """Another robot says which orders it has acknowledged."""
        mission, orders = (
            (beacon.mission_version, beacon.mission_tag),
            (beacon.stop_version, beacon.resume_version),
        )
        if mission < self._choice.mark:  # nearly all have all of it nearly always
            self._missions.lacks(now_ns, mission)
        if orders < self._latch.mark:
            self._orders.lacks(now_ns, orders)

    def accept_question(self, ask: Ask, now_ns: int) -> None:
        """An operator asks."""
        self._missions.asked(now_ns)
        self._orders.asked(now_ns)

    def look(self, now_ns: int, plant: PlantState | None, unmoved_ns: int) -> None:
        """Finds out what the own plant may have missed: of other robots it hears nothing.

        Args:
            plant: what it said last.
            unmoved_ns: for how long it has braked though the robot drives.
        """
        if unmoved_ns > UNMOVED_NS and now_ns - self._insisted_ns > UNMOVED_NS:
            self._insisted_ns = now_ns
            self._orders.insist()
        if plant is None or self._choice.mission is None or now_ns < self._plant_told_ns + AGAIN_NS:
            return
        # Its numbers count from the mission's epoch as soon as it has that.
        if plant.sequence != self._numbers.at(plant.time_ns):
            self._plant_told_ns = now_ns
            self._missions.insist()

    # ------------------------------------------------------------------ what it tells

    def due(self, now_ns: int) -> list[Outgoing]:
        """What is to be relayed now; a stop before the mission, since who catches up must not drive first."""
        tells = self._missions.due(now_ns)
        out: list[Outgoing] = []
        if self._orders.due(now_ns) or tells:
            out += [(self.key, encode(order)) for order in self._latch.latest]
        if tells and self._choice.mission is not None:
            out.append((self.key, encode(self._choice.mission)))
        return out
