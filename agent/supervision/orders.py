"""Operators' orders in a robot: the stop latch, orders that outlive a process, and relays (PURE).

The latch takes stops and resumes in both processes of a robot. A robot obeys an order at once. It
acknowledges the order when it is kept: on its disk, where it has one to keep orders on.

Any robot that has an order relays it to robots that lack it; there is no coordinator. Beacons show which
robots lack an order, or they ask. Each robot relays on its own key
(`agent.messages.key_expressions.relayed`). Mostly one robot does so, since all other agents hear that. A
robot always relays to those that may hear it alone, such as its plant, and what it has just received. In a
large fleet, which receives a mission or a resume at once, only the first robots relay it. An order is
relayed byte by byte: its codec keeps the bytes that came, which their sender signed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_plan import MissionChoice
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import Mark, can_be, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import Ask, Beacon, Mission, Outgoing, PlantState, Resume, Stop

AWAITED: Final = "waiting to be told to resume"
"""How a reason ends where only a resume is missing."""


class StopLatch:
    """The last stop and the last resume. A stop holds until a later resume for this robot.

    What comes first does not matter, nor how often: only versions decide. So whoever missed one takes it
    from anybody that says both again.

    Args:
        robot: whose process this is.
        on_resume: called when a resume names this robot or all, stopped or not.

    Attributes:
        version: of the last stop or resume that is known, 0 when there was none.
        lasting: what a process that starts again has to know of them; another object when it has changed.
    """

    def __init__(self, robot: int, on_resume: Callable[[], None]) -> None:
        self._robot, self._on_resume = robot, on_resume
        self._stop: Stop | None = None
        self._resume: Resume | None = None
        self._own: Resume | None = None
        """Of the resumes that name this robot or all: the greatest of all may be another's."""
        self._ahead: Stop | None = None
        """The last that came from ahead of time: it is said more than once, and may be replayed."""
        self._ahead_version = -1
        """As which version it holds here, -1 for none."""
        self._reason = ""
        """Of the stop that came last."""
        self.version = 0
        self.lasting: tuple[Stop | Resume, ...] = ()

    def accept_stop(self, stop: Stop) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        if self._stop is not None and stop.version <= self._stop.version:
            return None if stop.version == self._stop.version else "out_of_order"
        self._stop, self._reason = stop, stop.reason
        self._changed(stop)
        return None

    def accept_resume(self, resume: Resume) -> str | None:
        """Takes a message; returns why it is refused, None when it is not."""
        mine, known = self._is_mine(resume), self._resume
        if mine:
            self._own = resume
            self._on_resume()
        newest = known is None or resume.version > known.version
        if newest:
            self._resume = resume
        if mine or newest:
            self._changed(resume)
            return None
        return None if known is not None and resume.version == known.version else "out_of_order"

    def accept_ahead(self, order: Stop | Resume, now_ns: int) -> str:
        """Takes an order that cannot have been given yet; returns why it is refused.

        An operator's clock, or this one, is wrong by more than a day. A stop is a stop: it holds as one that
        is given now, after all that is known, so that the next resume of right clocks ends it. It is none of
        what is acknowledged, kept and said again: others have their own now. The operator learns the time
        from who hears it, and says it again as of that.
        """
        if isinstance(order, Stop) and order != self._ahead:
            self._ahead, self._reason = order, order.reason
            self._ahead_version = max(now_ns // 1_000, self.version)
        return "future"

    def recall(self, order: Stop | Resume) -> None:
        """Takes an order that this robot had taken before its process started again: of what a resume did
        then, nothing is done once more."""
        if isinstance(order, Stop):
            self.accept_stop(order)
            return
        if self._is_mine(order):
            self._own = order
        if self._resume is None or order.version > self._resume.version:
            self._resume = order
        self._changed(order)

    def _is_mine(self, resume: Resume) -> bool:
        """Whether a resume is for this robot, and later than those that it has had."""
        is_for_it = not resume.robots or self._robot in resume.robots
        return is_for_it and (self._own is None or resume.version > self._own.version)

    def _changed(self, by: Stop | Resume) -> None:
        self.version = max(self.version, by.version)
        own = self._own if self._own is not self._resume else None
        self.lasting = tuple(order for order in (self._stop, self._resume, own) if order is not None)

    @property
    def stopped(self) -> str:
        """Why the robot must stand, "" when it need not. Of equal versions the stop holds."""
        version = max(self._ahead_version, -1 if self._stop is None else self._stop.version)
        if version < 0 or (self._own is not None and version < self._own.version):
            return ""
        return f"stop: {self._reason}" if self._reason else "stop"

    @property
    def mark(self) -> tuple[int, int]:
        """What is known here, to compare: versions of the last stop and of the last resume, -1 for none."""
        return (
            -1 if self._stop is None else self._stop.version,
            -1 if self._resume is None else self._resume.version,
        )

    @property
    def latest(self) -> tuple[Stop | Resume, ...]:
        """What to say again to somebody that missed it, the stop first."""
        return tuple(message for message in (self._stop, self._resume) if message is not None)


Orders = tuple[bytes, ...]
"""Encoded orders: the last stop and resume, then the mission. Compared by identity, tick by tick."""


class LastingOrders:
    """What one process has to keep of the orders that `latch` and its mission are.

    Attributes:
        current: what is to be kept now; another object when it has changed.
        trouble: why what was to be kept is not, "" when it is.
        acknowledged: versions of the mission, and of the last stop or resume, that are kept; 0 for none.
    """

    def __init__(self, latch: StopLatch) -> None:
        self._latch: Final = latch
        self._mission: Mission | None = None
        self._of: tuple[tuple[Stop | Resume, ...], Mission | None] = latch.lasting, None
        self._has_disk = False
        self._versions = 0, 0
        self.current: Orders = ()
        self.trouble = ""
        self.acknowledged = 0, 0

    def has_disk(self) -> None:
        """From now on an order is kept when `kept` says so, and not as soon as it has come."""
        self._has_disk = True

    def look(self, mission: Mission | None) -> None:
        """Takes what holds at a tick."""
        latest = self._latch.lasting
        if latest is self._of[0] and mission is self._of[1]:
            return
        self._of = latest, mission
        orders: list[Stop | Resume | Mission] = [*latest, *([] if mission is None else [mission])]
        self.current = tuple(map(encode, orders))
        self._versions = 0 if mission is None else mission.version, self._latch.version
        if not self._has_disk:
            self.kept(self.current, "")

    def kept(self, orders: Orders, trouble: str) -> None:
        """Takes that `orders`, which were `current`, are kept, or why they cannot be.

        In that case the robot has done what it could: it acknowledges them, and says what is wrong.
        """
        self.trouble = trouble
        if orders is self.current:
            self.acknowledged = self._versions


AGAIN_NS: Final = NS_PER_S // 2
"""What was said is not said again for so long."""
LACKING_NS: Final = 2 * AGAIN_NS
"""To somebody who lacks it for so long it is said whoever else says it: he may not hear them, or one of them
lies to be heard by all but him."""
SPREAD_NS: Final = NS_PER_S // 50
"""Robots wait for different times, in steps of this: mostly one says it and the others hear it. Who ticks
more seldom than that needs longer ones."""
STEPS: Final = 8


class Gossip:
    """When robot `robot` says one thing again.

    Args:
        known: what this robot has of the thing; it is relayed to who has less.
        step_ns: robots wait for different times, in steps of this.
        is_shared: so many learn it at once that it is left to the first of them to say it at once; who lacks
            it then will show it.
    """

    def __init__(
        self, robot: int, known: Callable[[], Mark], step_ns: int = SPREAD_NS, *, is_shared: bool = False
    ) -> None:
        self._wait_ns, self._is_shared = step_ns * (robot % STEPS), is_shared
        self._known = known
        self._due_ns: int | None = None
        self._is_last_moment = False
        """Whether that is for somebody who has lacked it for so long that what others say does not count."""
        self._lacked_ns: int | None = None
        self._lacked_last_ns = 0
        self._said_ns = -AGAIN_NS
        self._insists = False

    def insist(self) -> None:
        """Somebody may hear this robot and nobody else: it is said here, whoever else says it."""
        self._insists = True

    def learnt(self, now_ns: int) -> None:
        """This robot has it from now on."""
        if self._is_shared:
            self.asked(now_ns)
        else:
            self.insist()

    def lacks(self, now_ns: int, mark: Mark) -> None:
        """Somebody has acknowledged only this much of it."""
        if mark >= self._known():
            return
        if self._lacked_ns is None or now_ns > self._lacked_last_ns + AGAIN_NS:
            self._lacked_ns = now_ns
        self._lacked_last_ns = now_ns
        if self._due_ns is None:
            last_ns = self._lacked_ns + LACKING_NS
            from_ns = max(now_ns, min(self._said_ns + AGAIN_NS, last_ns))
            self._due_ns, self._is_last_moment = from_ns + self._wait_ns, from_ns >= last_ns

    def asked(self, now_ns: int) -> None:
        """Somebody asks for it, who may not hear what others have said."""
        if self._due_ns is None:
            self._due_ns, self._is_last_moment = now_ns + self._wait_ns, False

    def said(self, now_ns: int, mark: Mark) -> None:
        """Somebody has said as much of it, maybe this robot."""
        if mark < self._known():
            return
        self._said_ns = now_ns
        if not self._is_last_moment:
            self._due_ns = None

    def due(self, now_ns: int) -> bool:
        """Whether to say it now."""
        if not self._insists and (self._due_ns is None or now_ns < self._due_ns):
            return False
        self._said_ns, self._insists = now_ns, False
        self._due_ns = self._lacked_ns = None
        self._is_last_moment = False
        return True


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
