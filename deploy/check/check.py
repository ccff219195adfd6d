"""What a fleet will do, and what in its file would go wrong: `handfast check`.

`check` looks for what is valid field by field (`agent.fleet.model` sees to that) but does not fit together:
distances that contradict places, robots that start too close, gains that the rate cannot carry. It
computes and never drives: everything here is geometry and linear algebra, in well under a second
for a few dozen robots. All findings come at once.
"""

from __future__ import annotations

from math import inf
from typing import Final

from handfast.agent.fleet.model import Fleet, FormationError
from handfast.agent.formation.geometry import Geometry, resolve
from handfast.deploy.check.bodies import check_motion, check_noise
from handfast.deploy.check.faults import check_faults
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.loop import (
    check_gains,
    check_loop,
    check_lowest_rate,
    check_saturation,
    check_sending,
    check_stiffness,
)
from handfast.deploy.check.network import check_network
from handfast.deploy.check.orders import check_orders
from handfast.deploy.check.safety import check_safety
from handfast.deploy.check.shape import check_shape, check_starts, check_structure, unplaced
from handfast.deploy.check.vehicles import check_vehicles

__all__ = ["Finding", "check"]

_ORDER: Final = {"error": 0, "warning": 1, "info": 2}


def check(fleet: Fleet) -> list[Finding]:
    """Everything worth saying about a fleet, errors first. Never raises for a fleet that was parsed."""
    findings = list(check_structure(fleet))
    geometry: Geometry | None = None
    if not any(finding.level == "error" for finding in findings):
        try:
            geometry = resolve(fleet)
        except FormationError as error:
            findings.append(Finding("error", "formation.distance_m", unplaced(str(error))))
    if geometry is not None:
        findings += check_shape(fleet, geometry)
        findings += check_starts(fleet, geometry)
        if float(geometry.distances.min(initial=inf)) > fleet.formation.safe_distance_m:
            findings += check_saturation(fleet, geometry)
            findings += check_loop(fleet, geometry)
            findings += check_stiffness(fleet, geometry)
        if fleet.control.law is not None:
            from handfast.deploy.check.own_law import check_own_law  # here: other fleets need none of it

            findings += check_own_law(fleet, geometry)
        findings += check_orders(fleet, geometry)
    findings += check_gains(fleet)
    findings += check_lowest_rate(fleet)
    findings += check_motion(fleet, geometry)
    findings += check_noise(fleet)
    findings += check_sending(fleet)
    findings += check_safety(fleet, geometry)
    findings += check_vehicles(fleet, geometry)
    if any(robot.kind.is_plugin for robot in fleet.robots):
        from handfast.deploy.check.own_plant import check_own_plants

        findings += check_own_plants(fleet)
    findings += check_faults(fleet)
    findings += check_network(fleet)
    return sorted(findings, key=lambda finding: _ORDER[finding.level])
