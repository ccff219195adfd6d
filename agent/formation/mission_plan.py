"""Plans, and the choice of the mission in force (PURE).

A plan is a mission written out for the fleet: who drives where, and who keeps which distance. A `Mission`
comes from the network and may hold anything that its types allow; a `Plan` can be driven. Agents, plants and
operators choose the mission here, so all that have received the same missions follow the same one, whatever
the order of reception. Lengths in m, frame W; times in ns of the wall clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot
from typing import TYPE_CHECKING, Any, ClassVar, Final

from handfast.agent.common.models import build
from handfast.agent.common.quantities import FAR_M, Vector
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import about
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import show
from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import check_trajectory
from handfast.agent.fleet.sections import TRAJECTORY_FIELDS, TrajectorySection
from handfast.agent.formation.trajectory import Sample, Trajectory, make_trajectory
from handfast.agent.messages.codec import Mark, mark_of, newer
from handfast.agent.messages.types import NEIGHBOURS_MAX, Mission, Setting

if TYPE_CHECKING:
    from handfast.agent.formation.geometry import Geometry


Edges = dict[tuple[int, int], float]
"""Wanted distance (m) of each edge (i, j), i < j."""
Formation = tuple[tuple[int, ...], Mapping[int, Vector], Edges]
"""Members, the place of each (m, W), and the edges between them."""
Parts = tuple[
    tuple[tuple[int, float, float], ...], tuple[tuple[int, int, float], ...], tuple[tuple[str, Any], ...]
]
"""`Mission.robots`, `Mission.edges` and `Mission.trajectory`."""


class PlanError(ValueError):
    """A mission that this fleet cannot drive; the text is one sentence that says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A mission with everything written out.

    Attributes:
        members: ids of the robots that have a place, in the file's order.
        offsets: place of each member relative to the reference point, m, W.
        edges: wanted distance of each edge (i, j), i < j, m.
        section, trajectory: what the reference point does; its time 0 is `trajectory_ns`.
        from_ns: when it is taken over.
        blend_ns: within which the motion before goes over to this one.
    """

    mission: Mission
    members: tuple[int, ...]
    offsets: Mapping[int, Vector]
    edges: Mapping[tuple[int, int], float]
    section: TrajectorySection
    trajectory: Trajectory
    trajectory_ns: int
    from_ns: int
    blend_ns: int

    def reference(self, time_ns: int) -> Sample:
        """The formation's reference point at a wall time."""
        return self.trajectory.at((time_ns - self.trajectory_ns) / NS_PER_S)


@dataclass(frozen=True, slots=True)
class _Root:
    """What `agent.common.reader.Reader` reads a mission's trajectory as."""

    trajectory: TrajectorySection = field(default_factory=TrajectorySection, metadata=about("Trajectory."))


def plan_of(mission: Mission, fleet: Fleet, geometry: Geometry | None) -> Plan:
    """The plan of a mission. A part that is empty in it is the fleet file's.

    Where it names robots, its edges are all the edges there are: none, if it gives none.

    Args:
        geometry: `agent.formation.geometry.resolve` of `fleet`; None for a fleet that is resolved.

    Raises:
        PlanError: for a mission that cannot be driven.
    """
    if mission.robots:
        return written_plan(mission, fleet)
    members, offsets, edges = _resolved_formation(fleet) if geometry is None else _formation(geometry)
    if mission.edges:
        edges = _given_edges(mission, offsets, fleet.formation.safe_distance_m)
    return _plan(mission, fleet, members, offsets, edges)


def written_plan(mission: Mission, fleet: Fleet) -> Plan:
    """`plan_of` of a mission that names its robots, as all but a drive's first do; raises as that does."""
    safe = fleet.formation.safe_distance_m
    offsets = _given_places(mission, fleet, safe)
    members = tuple(robot for robot in fleet.ids if robot in offsets)
    return _plan(mission, fleet, members, offsets, _given_edges(mission, offsets, safe))


def mission_parts(plan: Plan) -> Parts:
    """The plan as a mission writes it: its robots, edges and trajectory, nothing left to the fleet file."""
    robots = tuple((robot, *plan.offsets[robot]) for robot in plan.members)
    edges = tuple((i, j, distance) for (i, j), distance in plan.edges.items())
    return robots, edges, trajectory_parts(plan.section)


def trajectory_parts(section: TrajectorySection) -> tuple[Setting, ...]:
    """A trajectory as a mission writes it: the fields of its kind."""
    needed, taken = TRAJECTORY_FIELDS[section.kind]
    return tuple(Setting(key, getattr(section, key)) for key in ("kind", *needed, *taken))


def _formation(geometry: Geometry) -> Formation:
    members = geometry.ids
    offsets = {robot: (x, y) for robot, (x, y) in zip(members, geometry.offsets.tolist(), strict=True)}
    edges = {}
    for (i, j), distance in zip(geometry.edges.tolist(), geometry.distances.tolist(), strict=True):
        a, b = members[i], members[j]
        edges[min(a, b), max(a, b)] = distance
    return members, offsets, edges


def _resolved_formation(fleet: Fleet) -> Formation:
    formation = fleet.formation
    members = tuple(robot.id for robot in fleet.members)
    assert fleet.is_resolved
    assert formation.offsets is not None
    assert isinstance(formation.distance_m, tuple)
    edges = {
        (min(i, j), max(i, j)): d for (i, j), d in zip(formation.edges, formation.distance_m, strict=True)
    }
    return members, dict(zip(members, formation.offsets, strict=True)), edges


def _plan(
    mission: Mission, fleet: Fleet, members: tuple[int, ...], offsets: Mapping[int, Vector], edges: Edges
) -> Plan:
    # Most changes leave the trajectory as it is: of a large fleet all would check it in one moment.
    is_files = not mission.trajectory or mission.trajectory == trajectory_parts(fleet.trajectory)
    section = fleet.trajectory if is_files else _section(mission.trajectory)
    try:
        trajectory = make_trajectory(section)
    except ValueError as error:
        raise PlanError(f"the mission's {error}") from None
    epoch_ns = mission.epoch_ns
    return Plan(
        mission,
        members,
        offsets,
        edges,
        section,
        trajectory,
        mission.trajectory_ns or epoch_ns,
        mission.from_ns or epoch_ns,
        mission.blend_ns,
    )


def _given_places(mission: Mission, fleet: Fleet, safe: float) -> dict[int, Vector]:
    known = set(fleet.ids)
    offsets: dict[int, Vector] = {}
    for robot, x, y in mission.robots:
        if robot not in known:
            there_are = show(fleet.ids, 80)[1:-1]
            raise PlanError(f"robot {robot} is not in the fleet: its ids are {there_are}")
        if robot in offsets:
            raise PlanError(f"robot {robot} has two places")
        if not (abs(x) <= FAR_M and abs(y) <= FAR_M):
            raise PlanError(f"the place of robot {robot}, {show((x, y))}, is not within {FAR_M:g} m")
        offsets[robot] = x, y
    if not offsets:
        raise PlanError("no robot has a place")
    close = _closer(offsets, safe)
    if close is not None:
        i, j, apart = close
        raise PlanError(
            f"robots {i} and {j} would stand {apart:.4g} m apart, less than the safe distance of {safe:.4g} m"
        )
    return offsets


def _closer(offsets: Mapping[int, Vector], least: float) -> tuple[int, int, float] | None:
    """Two robots whose places are nearer to each other than `least`, and how near; None when none are."""
    cells: dict[tuple[int, int], list[int]] = {}
    for robot, (x, y) in offsets.items():
        column, row = int(x // least), int(y // least)
        for near in (
            other
            for i in (column - 1, column, column + 1)
            for j in (row - 1, row, row + 1)
            for other in cells.get((i, j), ())
        ):
            apart = hypot(x - offsets[near][0], y - offsets[near][1])
            if apart < least:
                return near, robot, apart
        cells.setdefault((column, row), []).append(robot)
    return None


def _given_edges(mission: Mission, offsets: Mapping[int, Vector], safe: float) -> Edges:
    edges: Edges = {}
    for i, j, distance in mission.edges:
        ends = (i, j) if i < j else (j, i)
        # All robots ask this of all edges in the moment in which a mission comes.
        if (
            i not in offsets
            or j not in offsets
            or i == j
            or ends in edges
            or not safe < distance <= FAR_M
            or offsets[i] == offsets[j]
        ):
            raise PlanError(_wrong_edge(i, j, distance, offsets, safe))
        edges[ends] = distance
    degrees = Counter(end for edge in edges for end in edge)
    for robot, degree in degrees.items():
        if degree > NEIGHBOURS_MAX:
            raise PlanError(f"robot {robot} has {degree} edges: it can have {NEIGHBOURS_MAX} at most")
    return edges


def _wrong_edge(i: int, j: int, distance: float, offsets: Mapping[int, Vector], safe: float) -> str:
    """What is wrong with an edge that is refused."""
    name = f"the edge [{i}, {j}]"
    for robot in (i, j):
        if robot not in offsets:
            return f"{name} names robot {robot}, which has no place in the formation"
    if i == j:
        return f"{name} joins a robot to itself"
    if not safe < distance <= FAR_M:
        return (
            f"{name} is to be {distance:.4g} m long: it must be longer than the safe distance of "
            f"{safe:.4g} m, and at most {FAR_M:g} m"
        )
    if offsets[i] == offsets[j]:
        return f"{name} joins two robots with the same place, {show(offsets[i])}"
    return f"{name} is given twice"


def _section(given: Sequence[tuple[str, Any]]) -> TrajectorySection:
    raw = dict(given)
    if len(raw) != len(given):
        raise PlanError("the mission gives a field of its trajectory twice")
    reader = Reader(_Root)
    values = reader.read({"trajectory": raw})["trajectory"]
    check_trajectory(values, raw, reader)
    if reader.problems:
        raise PlanError(f"the mission's {reader.problems[0]}")
    return build(TrajectorySection, values)


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
