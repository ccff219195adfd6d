"""The gains of a fleet's law, and how soft its constraints are at their scale (PURE).

With phi alone a formation of short edges is another one than one of long edges: phi has no unit, and where
forces are in balance depends on k_p / (k_2 c_1 s^2), with s = d - r_s. So k_2, where the fleet file does not
give it, goes with 1 / s^2, edge by edge: then every length of the law goes with the edges', and every time
stays what it is (docs/theory.md, J4).
"""

from __future__ import annotations

from typing import Final

from handfast.agent.control.law import Gains
from handfast.agent.control.safety_distances import speed_max
from handfast.agent.fleet.model import Fleet

SOFTNESS: Final = 4.0
"""k_2 s^2 of an edge (measured): above, folded shapes come apart; the less, the sooner a formation stands."""
FOLD: Final = 1.4
"""So many spans away from its place is a robot of a folded shape: its pull there must win (measured)."""


def gains_of(fleet: Fleet) -> Gains:
    """The gains of all edges of a fleet: k_2 as given, else as it goes with their span."""
    control = fleet.control
    if control.k2 is not None:
        return Gains(control.kd, control.k2, control.kp, control.relaxation)
    # From further away than c2 V / c1 the pull grows no more (N1), so what it has to win against must not.
    far = FOLD * control.c1 / (control.c2 * speed_max(fleet)) if fleet.avoidance.enabled else 0.0
    return Gains(control.kd, 0.0, control.kp, control.relaxation, SOFTNESS, SOFTNESS * far)


def one_sided(gains: Gains) -> Gains:
    """Those of a one-sided constraint: it acts from half of an edge's span on, as soft as that edge."""
    return gains._replace(near=0.25 * gains.near, far=0.5 * gains.far)


def softness(gains: Gains, span: float) -> float:
    """k_2 of an edge (J4), 1/m^2; span: d - r_s, m."""
    return gains.k2 + max(gains.near, gains.far * span) / (span * span)
