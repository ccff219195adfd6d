"""What became of a stop of a whole fleet: who brakes, since when, and by which way that is known (PURE)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final, NamedTuple

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import AHEAD_US_MAX, can_be
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import Message, PlantState, Status, Stop, clipped
from handfast.agent.supervision.state_machine import State
from handfast.deploy.console.wording import NAMES_SHOWN, clock_ahead, clock_behind, grouped, robots
from handfast.deploy.orders.robot_clocks import RobotClocks

BRAKING: Final = frozenset(
    state.value for state in (State.STOPPING, State.STOPPED, State.STANDBY, State.FAULT)
)
"""States of an agent that has acknowledged a stop."""
STOPPED: Final = frozenset({State.STOPPING.value, State.STOPPED.value})
"""Those of them in which it is a stop by which it brakes."""
PLANT_BRAKES: Final = "braking"
"""What a plant's process says of itself then (`agent.node.Node.condition`)."""
SAYS_BRAKES: Final = {"agent": BRAKING, "plant": frozenset({PLANT_BRAKES})}
"""By role: what a process says of itself that brakes."""
NEW_LINK: Final = "over a new link"
AGAIN_S: Final = 0.05
AGAIN_ROBOTS_HZ: Final = 500
"""So often a stop is said again, and no more often than that so many robots hear it a second."""
OUTDONE_MAX: Final = 3
"""So many later orders a robot may have had, one after the other; who tells of more makes them up."""
STOPS_OUTDONE_MAX: Final = 2
"""So many later stops by which robots brake are outdone: a program that ends gives one, which the next drive
lifts. Who gives more stops this fleet as well, and two that outdid each other would never come to an end."""


def again_s(fleet: Fleet) -> float:
    """After so long a stop is said again. In a large fleet, where each robot relays it as well, all would
    have more to do with hearing it than with braking: 100 heard it 50 times in the first 3 s."""
    return max(AGAIN_S, len(fleet.robots) / AGAIN_ROBOTS_HZ)


def has_acknowledged(status: Status | None, stop: Stop) -> bool:
    """Whether an agent that says this, or nothing, has acknowledged a stop and brakes."""
    return status is not None and status.order_version >= stop.version and status.state in BRAKING


def _reason(stop: Stop) -> str:
    """What an agent says that brakes by it (`agent.supervision.orders.StopLatch.stopped`)."""
    return clipped(f"stop: {stop.reason}" if stop.reason else "stop")


class _Brakes(NamedTuple):
    """Since when a process is known to brake (wall clock, ns), in what state, and by which way."""

    at_ns: int
    state: str
    way: str


class Stopping:
    """What becomes of a stop, from what comes after it by any way.

    Args:
        fleet: as it runs.
        now_ns: when it is sent (wall clock).
        reason: why, for people.
        message: the stop, where there is one already.

    Attributes:
        message: what to send, and to send again until `done`; it may change.
        ahead_s: how far this machine's clock is ahead of the robots', none of which believed the stop's time;
            0.0 where any did.
        clocks: how the robots' stand to this machine's.
    """

    def __init__(self, fleet: Fleet, now_ns: int, reason: str, message: Stop | None = None) -> None:
        self._ids, self._name, self._begun_ns = fleet.ids, fleet.fleet.name, now_ns
        self.message = message or Stop(now_ns // 1_000, now_ns, clipped(reason))
        self._given_version = self.message.version
        self.ahead_s = 0.0
        self.clocks: Final = RobotClocks()
        self._outdone: Counter[int] = Counter()
        self._stops_outdone = 0
        self._down: dict[tuple[int, str], str] = {}
        """Processes that are down and find the stop when they come up, by robot and role: by which way."""
        self._states: dict[int, tuple[str, int]] = {}
        """What each agent said last: its state, and the version of the stop or resume that it has."""
        self._kept: dict[int, int] = {}
        """By robot: the version of the last stop of which its computer said that its agent has kept it."""
        self._taken: set[int] = set()
        """Robots whose agent has acknowledged the stop, be it before it was outdone."""
        self._agents: dict[int, _Brakes] = {}
        self._plants: dict[int, _Brakes] = {}
        self._heard_plants: set[int] = set()

    def feed(self, now_ns: int, key: str, message: Message, way: str = NEW_LINK) -> None:
        """Takes a message that came on `key`, by a way, after the stop was sent first."""
        if type(message) is Status and key == key_expressions.status(self._name, message.robot):
            self.show_clock(now_ns, message.robot, message.time_ns)
            version, by_it = message.order_version, message.reason == _reason(self.message)
            if by_it and not self._is_believed_by(message.robot):
                version = self.message.version  # it can acknowledge no such version
            if message.state in BRAKING:  # it may have said so before its computer said more
                version = max(version, self._kept.get(message.robot, -1))
            self._hear_agent(now_ns, message.robot, message.state, version, way, by_it=by_it)
        elif type(message) is PlantState and key == key_expressions.plant_state(self._name, message.robot):
            self._heard_plants.add(message.robot)
            self._down.pop((message.robot, "plant"), None)
            if message.driving:
                self._plants.pop(message.robot, None)
            else:
                self._plants.setdefault(message.robot, _Brakes(now_ns, PLANT_BRAKES, way))

    def show_clock(self, now_ns: int, robot: int, there_ns: int) -> None:
        """Takes what a robot's clock shows, and has the message be of the robots' time where none believes
        this machine's."""
        self.clocks.show(robot, now_ns, there_ns)
        newest_ns = self.clocks.newest(now_ns)
        is_believed = can_be(self._given_version, newest_ns)
        if not is_believed and not self.ahead_s:
            # Robots brake at once, but what they keep and acknowledge is of their time.
            self.ahead_s = (now_ns - newest_ns) / NS_PER_S
            self.message = self.message._replace(version=newest_ns // 1_000)
        elif is_believed and self.ahead_s:
            self.ahead_s = 0.0
            self.message = self.message._replace(version=max(self._given_version, self.message.version))

    def found(self, now_ns: int, robot: int, role: str, state: str, version: int, way: str) -> None:
        """Takes what a robot's computer says of one of its processes: its state, and the version of the stop
        that it has kept, -1 without any."""
        if role == "agent":
            if state in BRAKING:
                self._kept[robot] = max(version, self._kept.get(robot, -1))
            self._hear_agent(now_ns, robot, state, version, way)
            return
        self._heard_plants.add(robot)
        if robot not in self._plants:
            self.has_had(robot, version, brakes=state in SAYS_BRAKES[role])
        if version >= self.message.version and state in SAYS_BRAKES[role]:
            self._plants.setdefault(robot, _Brakes(now_ns, state, way))

    def found_down(self, robot: int, role: str, version: int, laid: int, way: str) -> None:
        """Takes what a robot's computer says of a process that is down: the version of the order that it has
        kept, and of the stop that it finds when it comes up, each -1 without any."""
        self.has_had(robot, version)
        if version < self.message.version <= laid:
            self._down[robot, role] = way

    def outdo(self, version: int) -> None:
        """Has the message be later than an order that is known: this machine's clock may be behind that of
        who gave it, and far behind the robots'."""
        latest_ns = max(self._begun_ns, self.clocks.usual(self._begun_ns))
        if self.message.version <= version <= latest_ns // 1_000 + AHEAD_US_MAX:
            self.message = self.message._replace(version=version + 1)
            self._down.clear()

    def has_had(self, robot: int, version: int, *, brakes: bool = False) -> None:
        """Takes that a robot has had an order of that version.

        Args:
            brakes: it brakes by it.
        """
        if version > self.message.version and (not brakes or self._stops_outdone < STOPS_OUTDONE_MAX):
            before = self.message
            self._outdo_robot(robot, version)
            self._stops_outdone += brakes and self.message is not before

    def found_laid(self, robot: int, version: int) -> None:
        """Takes that a stop of that version lay where a robot looks for one, before this one did."""
        if version >= self.message.version:
            self._outdo_robot(robot, version)

    def _outdo_robot(self, robot: int, version: int) -> None:
        before = self.message
        if self._outdone[robot] < OUTDONE_MAX:
            self.outdo(version)
            self._outdone[robot] += self.message is not before

    def _is_believed_by(self, robot: int) -> bool:
        """Whether the message can have been given yet by a robot's clock."""
        its_ns = self.clocks.at(robot, self._begun_ns)
        return its_ns is None or can_be(self.message.version, its_ns)

    def _hear_agent(
        self, now_ns: int, robot: int, state: str, version: int, way: str, *, by_it: bool = False
    ) -> None:
        """Takes what an agent says, or is said of it.

        Args:
            by_it: it brakes by this stop, though it may not have kept it yet, which it then acknowledges.
        """
        if robot not in self._ids:
            return
        self._down.pop((robot, "agent"), None)
        self._states[robot] = state, version
        before = self.message
        if robot not in self._taken:
            self.has_had(robot, version, brakes=state in STOPPED)
            if state not in BRAKING:
                self._agents.pop(robot, None)
        obeys = self.message is before and self._obeys(robot)
        if obeys:
            self._taken.add(robot)
        if obeys or (by_it and state in BRAKING):
            self._agents.setdefault(robot, _Brakes(now_ns, state, way))

    def _obeys(self, robot: int) -> bool:
        """Whether the robot's agent has acknowledged the stop and brakes."""
        state, version = self._states.get(robot, ("", -1))
        return version >= self.message.version and state in BRAKING

    def stands_by(self, robot: int) -> bool:
        """Whether agent and plant of a robot both brake."""
        return self._obeys(robot) and robot in self._plants

    @property
    def is_being_kept(self) -> bool:
        """Whether a robot's agent brakes by the stop, which it has yet to keep and acknowledge."""
        return any(not self._obeys(robot) for robot in self._agents)

    @property
    def done(self) -> bool:
        """Whether all robots brake."""
        return all(map(self.stands_by, self._ids))

    @property
    def settled(self) -> bool:
        """Whether all robots brake, or are down and find the stop when they come up."""
        return all(self._is_down(robot) or self.stands_by(robot) for robot in self._ids)

    def _is_down(self, robot: int) -> bool:
        return all((robot, role) in self._down for role in ROLES)

    @property
    def heard(self) -> bool:
        """Whether anything of the fleet was heard, by any way."""
        return bool(self._states or self._heard_plants or self._down)

    def outcomes(self, *, each: bool) -> list[str]:
        """What became of it, in words: a line for each robot; unless `each`, how many brake, and
        what is with the others."""
        clock = [clock_ahead(self.ahead_s)] if self.ahead_s else []
        if behind_s := self.clocks.behind_s:
            clock = [clock_behind(behind_s)]
        return [*self._outcomes_of(self._ids, each=each), *clock]

    def outcomes_elsewhere(self, ids: Sequence[int]) -> list[str]:
        """The same of robots that brake, but did not acknowledge it to who gave it: a line for all of them
        where they are many."""
        if len(ids) <= NAMES_SHOWN:
            return self._outcomes_of(ids, each=True)
        brake, *others = self._outcomes_of(ids, each=False)
        return [f"not acknowledged here by {len(ids)} of {len(self._ids)} robots: {brake}", *others]

    def _outcomes_of(self, ids: Sequence[int], *, each: bool) -> list[str]:
        """The same of some robots, without what is wrong with this machine's clock."""
        if each:
            return [self.outcome(robot) for robot in ids]
        ways: Counter[str] = Counter()
        last_ns, said = 0, []
        for robot in ids:
            if not self.stands_by(robot):
                said.append((self._words(robot), robot))
                continue
            known = [by[robot] for by in (self._agents, self._plants) if robot in by]
            last_ns = max(last_ns, *(brakes.at_ns for brakes in known))
            ways[" and ".join(dict.fromkeys(brakes.way.partition(" to ")[0] for brakes in known))] += 1
        lines = [f"{robots(them)}: {text}" for text, them in grouped(said)]
        summary = f"{ways.total()} of {len(ids)} robots brake"
        if ways:
            by_way = ", ".join(f"{count} {way}" for way, count in ways.most_common())
            summary += f", the last after {(last_ns - self._begun_ns) / 1e6:.0f} ms ({by_way})"
        return [summary, *lines]

    def outcome(self, robot: int) -> str:
        """What became of it for one robot, in words."""
        return f"robot {robot}: {self._words(robot)}"

    def _words(self, robot: int) -> str:
        if self._is_down(robot):
            return f"is down; it finds the stop when it comes up ({self._down[robot, 'agent']})"
        agent, plant = self._agents.get(robot), self._plants.get(robot)
        ways = dict.fromkeys(each.way for each in (agent, plant) if each is not None)
        by = f" ({', '.join(ways)})" if ways and self.stands_by(robot) else ""
        return f"{self._agent_words(robot)}, {self._plant_words(robot)}{by}"

    def _agent_words(self, robot: int) -> str:
        if robot not in self._states:
            return "nothing heard from its agent"
        (state, version), brakes = self._states[robot], self._agents.get(robot)
        if self._obeys(robot) and brakes is not None:
            return f"{state} after {self._ms(brakes)}"
        if brakes is not None and state in BRAKING:
            missing = (
                "by an earlier stop: it has not taken the last one yet"
                if robot in self._taken
                else "and has not kept the stop yet: started again, it would not know of it"
            )
            return f"{state} after {self._ms(brakes)}, {missing}"
        if brakes is not None and version > self.message.version:
            return f"{state}: another operator has let it drive again"
        if state in BRAKING and version < 0:
            return f"{state}: its agent has kept no order, so by which is not known"
        return f"{state}: its agent has not taken the stop" if state else "its agent has not taken the stop"

    def _plant_words(self, robot: int) -> str:
        if robot in self._plants:
            return f"its plant brakes after {self._ms(self._plants[robot])}"
        return "its plant does not brake" if robot in self._heard_plants else "nothing heard from its plant"

    def _ms(self, brakes: _Brakes) -> str:
        return f"{(brakes.at_ns - self._begun_ns) / 1e6:.0f} ms"
