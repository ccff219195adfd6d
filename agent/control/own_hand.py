"""Where the own hand is: as the plant measures it, for a while after that by dead reckoning (PURE)."""

from __future__ import annotations

from math import exp, hypot
from typing import Final

from handfast.agent.common.time import NS_PER_MS, NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.prediction import BRAKING_TIME_S
from handfast.agent.control.peers.rolling import ROLL_ERROR, Rolls, arc, middle, moves
from handfast.agent.messages.types import FLOAT_MAX, LOST_MS_MAX, PlantState, Setpoint

LAST_PLACE_NS: Final = NS_PER_S
"""A robot whose plant is lost says for so long where it must have come to rest. Then its silence says that
this grows uncertain."""


class OwnHand:
    """The own hand point, found anew at every tick.

    Args:
        rolls: what is known of a body that goes on as it went when nothing commands it any more.

    Attributes:
        here: where it is (m, m/s, W), None when the plant does not say.
        shown: `here`, or where it must be since; None when the plant was lost long ago.
        doubt: how far it may be from `shown`, m.
        obeys: what the body goes on by when nothing commands it any more, while it is measured and moves;
            once it is lost, what it went on by since it was measured last.
        lost_ms: so long ago that was, ms, 0 while it is measured.
    """

    def __init__(self, controller: Controller, rolls: Rolls | None = None) -> None:
        self._controller, self._rolls = controller, rolls
        self.here: Hand | None = None
        self.shown: Hand | None = None
        self.doubt = 0.0
        self.obeys: tuple[Setpoint, ...] = ()
        self.lost_ms = 0
        self._seen: tuple[int, Hand, PlantState] | None = None

    def measured(self, now_ns: int, plant: PlantState) -> bool:
        """Finds it by a plant's state that may be used; False when that is an impossible place."""
        here = self._controller.hand_at(plant, now_ns)
        x, y, vx, vy = here
        if not (
            abs(x) <= FLOAT_MAX and abs(y) <= FLOAT_MAX and abs(vx) <= FLOAT_MAX and abs(vy) <= FLOAT_MAX
        ):
            return False  # nor one that is no number
        self._seen = now_ns, here, plant
        self.here = self.shown = here
        self.doubt, self.lost_ms = 0.0, 0
        if self._rolls is not None:
            self.obeys = (self._controller.obeys(plant, now_ns),) if moves(vx, vy) else ()
        return True

    def lost(self, now_ns: int) -> None:
        """The plant does not say where the body is.

        The others must not go on taking it for a robot that drives. It may have stopped where it was measured
        last, or have driven on until it was missed and braked since: it is somewhere on this way.
        """
        self.here = self.shown = None
        self.obeys, self.lost_ms = (), 0
        if self._seen is None:
            return
        since_ns, here, plant = self._seen
        near = self._controller.hand_at(plant, plant.time_ns)
        rolls = self._rolls if moves(near.vx, near.vy) else None
        if now_ns - since_ns > LAST_PLACE_NS + (rolls.for_s if rolls else 0.0) * NS_PER_S:
            return
        if rolls:
            self._roll_on(near, self._controller.obeys(plant, plant.time_ns), rolls)
            self.lost_ms = min(max(1, (now_ns - plant.time_ns) // NS_PER_MS), LOST_MS_MAX)
            return
        remains = exp(-(now_ns - since_ns) / NS_PER_S / BRAKING_TIME_S)
        way = BRAKING_TIME_S * (1.0 - remains)
        x, y = here.x + way * here.vx, here.y + way * here.vy
        self.doubt = 0.5 * hypot(x - near.x, y - near.y)
        self.shown = Hand(0.5 * (x + near.x), 0.5 * (y + near.y), remains * here.vx, remains * here.vy)

    def _roll_on(self, near: Hand, obeys: Setpoint, rolls: Rolls) -> None:
        """Of a body with a watchdog of its own: it may stand where it was measured last, or go on as it went
        until that stops it. All of this way is told at once, as a circle, for as long as it may roll: its
        agent may be the next that is not heard."""
        way = arc(near.x, near.y, obeys, rolls)
        x, y = middle(way)
        self.doubt = ROLL_ERROR + max(hypot(x - at_x, y - at_y) for _, at_x, at_y in way)
        self.shown, self.obeys = Hand(x, y, 0.0, 0.0), (obeys,)
