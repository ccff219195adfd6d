"""What an operator orders of a fleet, and the newest orders that were heard of anybody (PURE).

`handfast run` and `simulate` carry out the fleet file's ``[[order]]`` with it, and commands such as
``handfast change`` theirs. Times are wall-clock nanoseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.geometry import Geometry
from handfast.agent.formation.mission_plan import MissionChoice, MissionRefused, Plan
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import Mark, as_believed, can_be, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import (
    FUTURE_NS_MAX,
    Ask,
    Beacon,
    Heartbeat,
    Message,
    Mission,
    Outgoing,
    PlantState,
    Resume,
    Status,
    Stop,
    clipped,
)
from handfast.agent.supervision.state_machine import DRIVING_NAMES
from handfast.deploy.console.wording import clock_ahead
from handfast.deploy.orders.mission_editing import OrderError, first_mission, ordered

HEARTBEAT_PERIOD_NS: Final = 100_000_000
HEARD_NS: Final = 2_000_000_000
"""Who has said something within so long is heard; agents say their status five times a second."""
NO_MISSION: Final = "the fleet has no mission yet: nothing can be changed before it drives"

Order = Mission | Stop | Resume


def refused(order: OrderSection, error: OrderError) -> str:
    """The sentence for the verdict on a run one of whose orders cannot be carried out."""
    return f"The order at {order.at:g} s ({order.kind}) was not given: {error}."


class Known:
    """The newest orders that were heard of a fleet, whoever gave them.

    Args:
        fleet: resolved.
        geometry: `agent.formation.geometry.resolve` of it.

    Attributes:
        stop, resume: the newest ones.
        foreign: a mission for another fleet file, which robots have taken: they read that one.
        keys: the key of each type of message that operators send.
        relay_keys: the keys on which robots relay operators' orders.
    """

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        self.fleet: Final = fleet
        self._missions = MissionChoice(fleet, geometry)
        self.stop: Stop | None = None
        self.resume: Resume | None = None
        self.foreign: Mission | None = None
        name = fleet.fleet.name
        self.keys: Final[Mapping[type[Message], str]] = {
            Mission: key_expressions.mission(name),
            Stop: key_expressions.stop(name),
            Resume: key_expressions.resume(name),
            Heartbeat: key_expressions.heartbeat(name),
            Ask: key_expressions.ask(name),
        }
        self.relay_keys: Final = frozenset(key_expressions.relayed(name, robot) for robot in fleet.ids)

    def hear(self, key: str, message: Message) -> bool:
        """Takes a message that came on `key`; True for an order that is newer than those before."""
        if key not in self.relay_keys and key != self.keys.get(type(message)):
            return False
        if type(message) is Mission:
            if key in self.relay_keys and not self._missions.is_ours(message):
                self.foreign = message
            return self._take(message)
        if type(message) is Stop and (self.stop is None or message.version > self.stop.version):
            self.stop = message
            return True
        if type(message) is Resume and (self.resume is None or message.version > self.resume.version):
            self.resume = message
            return True
        return False

    def hear_at(self, now_ns: int, key: str, message: Message) -> Order | None:
        """As `hear`, at a time (wall clock) by which orders are believed; returns an order that is newer than
        those before, as it is believed."""
        if not isinstance(message, Mission | Stop | Resume):
            self.hear(key, message)
            return None
        order = as_believed(message, now_ns)
        return order if order is not None and self.hear(key, order) else None

    def _take(self, mission: Mission) -> bool:
        try:
            return self._missions.take(mission) is not None
        except MissionRefused:
            return False  # no agent takes it either

    @property
    def mission(self) -> Mission | None:
        """The newest mission that this fleet can drive."""
        return self._missions.mission

    @property
    def plan(self) -> Plan | None:
        """What that mission means."""
        return self._missions.plan

    @property
    def digest(self) -> str:
        """Of this fleet file: robots that read another one take no mission of this operator."""
        return self._missions.digest

    @property
    def mission_version(self) -> int:
        """Of the newest mission, 0 without any."""
        return 0 if self.mission is None else self.mission.version

    @property
    def mission_mark(self) -> Mark:
        """What tells the newest mission from others of its version too."""
        return self._missions.mark

    @property
    def order_version(self) -> int:
        """Of the newest stop or resume, 0 without any."""
        return max((each.version for each in self.latest), default=0)

    @property
    def stop_in_force(self) -> Stop | None:
        """The stop by which robots stand, None without any.

        A resume of single robots ends it for no others.
        """
        stop, resume = self.stop, self.resume
        if stop is None or (resume is not None and resume.version > stop.version and not resume.robots):
            return None
        return stop

    @property
    def latest(self) -> list[Stop | Resume]:
        """The newest stop and the newest resume, the stop first."""
        return [each for each in (self.stop, self.resume) if each is not None]


class Operator(Known):
    """Gives orders, each of a version greater than any that was heard of, and sends them again."""

    def __init__(self, fleet: Fleet, geometry: Geometry) -> None:
        super().__init__(fleet, geometry)
        self._acknowledged = dict.fromkeys(fleet.ids, (0, 0))
        """What each robot acknowledged last: versions of a mission, and of a stop or resume."""
        self._times: dict[int, int] = {}
        """What each robot's clock showed last, ns."""
        self._marks: dict[int, Mark] = {}
        """The mission that each robot's beacon told last: which of those of one version it is."""

    def hear(self, key: str, message: Message) -> bool:
        name = self.fleet.fleet.name
        if type(message) is Status and key == key_expressions.status(name, message.robot):
            self._acknowledge(message.robot, message.mission_version, message.order_version)
            self._times[message.robot] = message.time_ns
        elif type(message) is Beacon and key == key_expressions.beacon(name, message.robot):
            order_version = max(message.stop_version, message.resume_version)
            self._acknowledge(message.robot, message.mission_version, order_version)
            self._marks[message.robot] = message.mission_version, message.mission_tag
        return super().hear(key, message)

    def _acknowledge(self, robot: int, mission_version: int, order_version: int) -> None:
        if robot in self._acknowledged:
            self._acknowledged[robot] = mission_version, order_version

    @property
    def behind(self) -> bool:
        """Whether agents have acknowledged an order that was not heard here: they relay it when asked."""
        mission_version, order_version, known = self.mission_version, self.order_version, self.mission_mark
        return any(
            mission > mission_version or order > order_version
            for mission, order in self._acknowledged.values()
        ) or any(mark > known for mark in self._marks.values())

    def ahead(self, now_ns: int) -> list[int]:
        """Robots that have acknowledged an order which was not heard here, if its version can be true."""
        return [
            robot
            for robot, (mission, order) in sorted(self._acknowledged.items())
            if (self.mission_version < mission and can_be(mission, now_ns))
            or (self.order_version < order and can_be(order, now_ns))
        ]

    def without(self, stop: Stop, robots: Iterable[int]) -> list[int]:
        """Those of these robots that have acknowledged neither a stop nor what came after it."""
        return [robot for robot in robots if self._acknowledged[robot][1] < stop.version]

    def clock_trouble(self, now_ns: int) -> str:
        """What is wrong with this machine's clock where no robot that is heard would believe an order of now,
        but a stop; "" when nothing is."""
        newest_ns = max(self._times.values(), default=now_ns)
        return "" if can_be(now_ns // 1_000, newest_ns) else clock_ahead((now_ns - newest_ns) / NS_PER_S)

    # ------------------------------------------------------------------ orders

    def begin(self, now_ns: int, epoch_ns: int, duration_ns: int) -> Mission:
        """The drive's first mission: what the fleet file says."""
        mission = first_mission(self.fleet, self._next_mission(now_ns), now_ns, epoch_ns, duration_ns)
        self._take(mission)
        return mission

    def give(self, order: OrderSection, now_ns: int, heard: Collection[int] | None = None) -> Order:
        """The message that carries out an order which is given now.

        Args:
            heard: the robots that are heard (`HEARD_NS`); None where nobody can tell, as before a drive.

        Raises:
            OrderError: it cannot be carried out; the text is one sentence that says why.
        """
        if order.kind == "stop":
            return self.order_stop(now_ns)
        if order.kind == "resume":
            return self.order_resume(now_ns, order.robots or ())
        if self.plan is None:
            raise OrderError(NO_MISSION)
        mission = ordered(order, self.plan, self.fleet, now_ns, self._next_mission(now_ns), heard=heard)
        self._take(mission)
        return mission

    def order_stop(self, now_ns: int, reason: str = "") -> Stop:
        """Return a stop of every robot; `reason` is shown to operators."""
        self.stop = Stop(self._next_order(now_ns), now_ns, clipped(reason))
        return self.stop

    def order_resume(self, now_ns: int, robots: Sequence[int], given_ns: int | None = None) -> Resume:
        """A resume for these robots, for all when none is named.

        Args:
            given_ns: when somebody gave it, if that was before: it is older than a stop that was given since,
                whichever robots hear first.
        """
        if given_ns is None:
            version = self._next_order(now_ns)
        else:
            # What robots have, and was not heard here, may have been given since.
            most = max(given_ns // 1_000, self.order_version)
            had = [order for _, order in self._acknowledged.values() if order <= most]
            version = _next(given_ns, self.order_version, had)
        self.resume = Resume(version, now_ns, tuple(robots))
        return self.resume

    def _next_mission(self, now_ns: int) -> int:
        return _next(now_ns, self.mission_version, [mission for mission, _ in self._acknowledged.values()])

    def _next_order(self, now_ns: int) -> int:
        return _next(now_ns, self.order_version, [order for _, order in self._acknowledged.values()])

    def outgoing(self, message: Order | Heartbeat | Ask) -> Outgoing:
        """A message as it goes on the bus."""
        return self.keys[type(message)], encode(message)

    # ------------------------------------------------------------------ sent again

    def again(self) -> list[Order]:
        """The orders for a process that has just started; a stop before the mission, or it would drive."""
        return [*self.latest, *([] if self.mission is None else [self.mission])]

    def wanted(
        self,
        statuses: Mapping[int, Status],
        plants: Mapping[int, PlantState],
        up: Callable[[int, str], bool],
    ) -> list[Order]:
        """The orders to send again, because a process has not acknowledged them.

        Args:
            statuses, plants: what each agent and plant said last; nothing since it started again.
            up: whether a process (robot, role) should run.
        """
        version = self.mission_version
        for robot in self.fleet.ids:
            status = statuses.get(robot)
            behind = status is not None and (
                status.mission_version < version or self._other_of(version, robot) < self.mission_mark
            )
            if up(robot, "agent") and behind:
                return self.again()
            if up(robot, "plant") and not self.has_epoch(plants.get(robot)):
                return self.again()
        if any(
            self._lacks_order(statuses.get(robot), plants.get(robot), up(robot, "agent"))
            for robot in self.fleet.ids
        ):
            return [*self.latest]
        return []

    def _other_of(self, version: int, robot: int) -> Mark:
        """The mission of that version that a robot has, the own one where it has told no other."""
        mark = self._marks.get(robot, (0, 0))
        return mark if mark[0] == version else self.mission_mark

    def has_epoch(self, plant: PlantState | None) -> bool:
        """Whether a plant has the mission's epoch: its sequence numbers count from that."""
        if plant is None or self.mission is None:
            return False
        numbers = SequenceNumbers(self.fleet.period_ns)
        numbers.begin(self.mission.epoch_ns)
        return plant.sequence == numbers.at(plant.time_ns)

    def _lacks_order(self, status: Status | None, plant: PlantState | None, agent_up: bool) -> bool:
        if status is None or not agent_up or not self.latest:
            return False
        if status.order_version < self.order_version:
            return True
        # A plant acknowledges no orders: one that missed a resume brakes although its agent drives.
        braked = plant is not None and plant.healthy and plant.obeying and not plant.driving
        return status.state in DRIVING_NAMES and braked


def is_since(stop: Stop, given_ns: int, now_ns: int) -> bool:
    """Whether a stop was given after something else was, at `given_ns`: that is not what it was to lift. One
    of a time that is still to come was given by a clock that is ahead: nobody knows when."""
    return given_ns < stop.time_ns <= now_ns + FUTURE_NS_MAX


def _next(now_ns: int, known: int, acknowledged: Iterable[int]) -> int:
    """Lamport's clock, in us of the wall clock where that is ahead of all that was seen.

    Args:
        known: the greatest version of an order that was heard.
        acknowledged: those that robots say they have; one that cannot be true is left out.
    """
    believed = (version for version in acknowledged if can_be(version, now_ns))
    return max(now_ns // 1_000, known + 1, max(believed, default=0) + 1)
