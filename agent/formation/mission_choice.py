"""Which mission holds for one who hears them in any order (PURE).

Agents, plants and operators all decide here: whoever has heard the same missions follows the same one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_plan import Plan, PlanError, plan_of
from handfast.agent.messages.codec import Mark, mark_of, newer
from handfast.agent.messages.types import Mission

if TYPE_CHECKING:
    from handfast.agent.formation.geometry import Geometry  # numpy: plants do without


class MissionRefused(ValueError):
    """A mission that no robot of this fleet drives.

    Attributes:
        reason: ``digest``, it is for another fleet file; ``mission``, it cannot be driven.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class MissionChoice:
    """The mission that holds: of those for this fleet file that can be driven the greatest by
    `agent.messages.codec.newer`, whatever came before it.

    Args:
        fleet: whose missions they are.
        geometry: `agent.formation.geometry.resolve` of `fleet`; None for a fleet that is resolved.

    Attributes:
        digest: of this fleet file.
        mission, plan: the one that holds and what it means, None before the first.
        mark: tells it from every other one, (0, 0) before the first.
    """

    _planned: ClassVar[tuple[Mission, Fleet, Plan] | None] = None
    """The plan made last in this process, and of what: by identity, so that it is of nothing else."""

    def __init__(self, fleet: Fleet, geometry: Geometry | None) -> None:
        self._fleet, self._geometry = fleet, geometry
        self.digest: Final = digest(fleet)
        self.mission: Mission | None = None
        self.plan: Plan | None = None
        self.mark: Mark = (0, 0)

    def is_ours(self, mission: Mission) -> bool:
        """Whether it is for this fleet file."""
        return mission.digest == self.digest

    def mark_of(self, mission: Mission) -> Mark:
        """Its mark. Most that come are the one that holds, as it is said until all have it."""
        return self.mark if mission is self.mission else mark_of(mission)

    def holds(self, mission: Mission) -> bool:
        """Whether it is the one that holds."""
        return self.mark_of(mission) == self.mark

    def take(self, mission: Mission) -> Plan | None:
        """Takes a mission; its plan if it holds from now on, None if the one before does.

        Raises:
            MissionRefused: nobody drives it.
        """
        if not newer(mission, self.mission) and self.is_ours(mission):
            return None
        if not self.is_ours(mission):
            raise MissionRefused(
                "digest",
                f"the mission is for another fleet file: its digest is {mission.digest[:16]}, "
                f"this agent's is {self.digest}",
            )
        plan = self._plan(mission)
        self.mission, self.plan, self.mark = mission, plan, mark_of(mission)
        return plan

    def _plan(self, mission: Mission) -> Plan:
        """Its plan: that which another robot of this process has made of the same message, if one has."""
        planned = MissionChoice._planned
        if planned is not None and planned[0] is mission and planned[1] is self._fleet:
            return planned[2]
        try:
            plan = plan_of(mission, self._fleet, self._geometry)
        except PlanError as error:
            raise MissionRefused("mission", f"the mission cannot be driven: {error}") from None
        MissionChoice._planned = mission, self._fleet, plan
        return plan
