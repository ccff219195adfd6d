"""What a drive says to a fleet that was up before, and when: robots made by the test, on a bus that notes."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from io import StringIO
from types import SimpleNamespace
from typing import Any, cast

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import Ask, Heartbeat, Message, Mission, PlantState, Resume, Status, Stop
from handfast.agent.transport.bus import Bus
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.attached import Attached
from handfast.deploy.drive.display.live_view import Lines
from handfast.deploy.drive.drive import FRESH_NS, SHOW_FIRST_NS, SHOW_PERIOD_NS, STOOD_NS, Drive
from handfast.deploy.drive.preconditions import BROKEN_OFF, OVER, Timing, refusal
from handfast.deploy.faults.process_actions import Action
from handfast.deploy.orders.operator import Operator
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.session.session import valid
from tests.unit.deploy.orders.order_fleets import order

S = 1_000_000_000
QUICK = Timing(stopped_ahead_ns=3 * S // 2, stop_again_s=0.05, stop_s=0.6)
"""Robots of this test need no more."""
FLEET = parse_fleet(
    """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0.2 }]
fleet = { name = "two", rate_hz = 50 }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }
""",
    source="two",
)
TOLD = key_expressions.relayed("two", 1)
STOP = Stop(5, 100 * S, "a person")
LATER = time.time_ns() // 1_000 + 3_600_000_000
"""A version that is greater than any of this century."""


class Robots:
    """Robots of `FLEET` as a `Bus` shows them: they tell `history`, and take what is said to them.

    Attributes:
        said: what was published, each with the versions that the robots had acknowledged at that time.
        late_s: how long after a mission each takes it; None: never.
        refuses: robots whose file is another.
        deaf: robots that take no stop and no resume.
        boasts: versions of a mission and of a stop or resume that a robot says it has, true or not.
        gone: robots whose plants disappear when they have taken the mission.
    """

    def __init__(self, state: str, *history: Mission | Stop | Resume) -> None:
        self.state, self.history = state, history
        self.said: list[tuple[Message, list[int]]] = []
        self.late_s: dict[int, float | None] = {1: 0.0, 2: 0.0}
        self.refuses: set[int] = set()
        self.deaf: set[int] = set()
        self.boasts: dict[int, tuple[int, int]] = {}
        self.gone: set[int] = set()
        self._left: set[int] = set()
        self.on_mission: Callable[[], list[tuple[str, Message]]] = list
        self._extra: list[tuple[str, Message]] = []
        self._missions = [each for each in history if type(each) is Mission]
        self._mission = self._missions[-1] if self._missions else None
        self._given: tuple[float, Mission] | None = None
        self._orders = max((each.version for each in history if type(each) is not Mission), default=0)
        self._asked = False

    def declare(self, key: str) -> None: ...
    def subscribe(self, key: str, size: int) -> None: ...

    def watch(self, key: str) -> Robots:
        self._changes = [
            (key_expressions.alive("two", robot, role), True)
            for robot in (1, 2)
            for role in key_expressions.ROLES
        ]
        return self

    def update(self) -> list[tuple[str, bool]]:
        changes, self._changes = self._changes, []
        return changes

    def publish(self, key: str, payload: bytes) -> None:
        message = decode(payload)
        self.said.append((message, [self.version(robot) for robot in (1, 2)]))
        if type(message) is Stop:
            self.state = "stopped"
        if type(message) is Ask:
            self._asked = True
        elif type(message) is Mission and (self._given is None or self._given[1] != message):
            self._given = time.monotonic(), message
            self._extra += self.on_mission()
        elif type(message) is Stop or type(message) is Resume:
            self._orders = message.version

    def known(self, robot: int) -> Mission | None:
        late_s = self.late_s[robot]
        if self._given is None or late_s is None or robot in self.refuses:
            return self._mission
        given_s, mission = self._given
        return mission if time.monotonic() >= given_s + late_s else self._mission

    def version(self, robot: int) -> int:
        known = self.known(robot)
        return 0 if known is None else known.version

    def drain(self) -> Iterator[tuple[str, bytes]]:
        now_ns = time.time_ns()
        if self._asked:
            self._asked = False
            self._extra += [(TOLD, order) for order in self.history]
        for key, message in self._extra:
            yield key, encode(message)
        self._extra = []
        for robot in (1, 2):
            orders = self._orders if robot not in self.deaf else 0
            given, refuses = self._given is not None, robot in self.refuses
            counters = (("rejected.digest", 3 + given),)  # others' missions too
            tell_digest = () if not given else ("of another",) if refuses else (digest(FLEET),)
            yield (
                key_expressions.status("two", robot),
                encode(
                    Status(
                        *(robot, 1, now_ns, self.state, "", ""),
                        *self.boasts.get(robot, (self.version(robot), orders)),
                        *((), (), (), counters, tell_digest),
                    )
                ),
            )
            if robot in self._left:
                continue
            known = self.known(robot)
            since_ns = 0 if known is None else (now_ns - known.epoch_ns) // FLEET.period_ns
            number = 7 if known is None else FIRST_ROUND + since_ns
            yield (
                key_expressions.plant_state("two", robot),
                encode(PlantState(robot, number, now_ns, *[0.0] * 7, True, True, True, "")),
            )
            if robot in self.gone and self._given is not None:
                self._left.add(robot)
                self._changes.append((key_expressions.alive("two", robot, "plant"), False))

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message, _ in self.said if type(message) is kind]


def driven(robots: Robots, **options: Any) -> tuple[Drive, str]:
    interrupt = options.pop("interrupt", Interrupt())
    detach, fleet = options.pop("detach", False), options.pop("fleet", FLEET)
    options.setdefault("duration_s", 0.2)
    options.setdefault("timing", QUICK)
    stream, record = options.pop("stream", StringIO()), options.pop("record", unrecorded)
    drive = Drive(
        *(fleet, options.pop("processes", None) or Attached(fleet), cast(Bus, robots), record),
        *(Lines(stream, quiet=True, period_s=1.0), interrupt),
        **options,
    )
    drive.run(detach=detach)
    return drive, stream.getvalue()


def unrecorded(_now_ns: int, _key: str, payload: bytes) -> Message | None:
    return valid(payload)


def over(fleet: Fleet = FLEET) -> Mission:
    now_ns = time.time_ns()
    return Mission(3, now_ns - 60 * S, now_ns - 50 * S, 10 * S, digest(fleet))


def test_a_fleet_that_is_ready_gets_a_mission_and_at_its_end_a_stop() -> None:
    robots = Robots("ready")
    drive, _ = driven(robots)
    assert drive.reasons == []
    (mission,) = robots.of(Mission)
    assert (mission.duration_ns, mission.digest) == (S // 5, digest(FLEET))
    assert {stop.reason for stop in robots.of(Stop)} == {OVER}
    assert robots.of(Resume) == []


def test_a_resume_comes_when_all_have_acknowledged_the_mission() -> None:
    robots = Robots("stopped", over(), STOP)
    robots.late_s = {1: 0.0, 2: 0.4}
    drive, said = driven(robots, resume=True)
    assert drive.reasons == []
    assert "lifting the stop that was given at" in said
    assert "told to stop" not in said  # what was before it is no news
    kinds = [type(message) for message, _ in robots.said if type(message) is not Ask]
    assert kinds.index(Resume) > kinds.index(Mission)
    (resume, known), *_ = [each for each in robots.said if type(each[0]) is Resume]
    mission = robots.of(Mission)[0]
    assert known == [mission.version] * 2
    assert isinstance(resume, Resume)
    assert resume.version > STOP.version
    assert resume.robots == ()
    assert mission.epoch_ns - resume.time_ns > 0.4 * S


def test_who_does_not_take_the_mission_gets_no_resume() -> None:
    robots = Robots("stopped", over(), Stop(5, 100 * S, OVER))
    robots.late_s = {1: 0.0, 2: None}
    drive, _ = driven(robots)
    assert drive.reasons == ["Not started: robot 2 did not take the mission."]
    assert robots.of(Resume) == []
    assert robots.of(Stop)[-1].reason == drive.reasons[0]


def test_a_stop_that_comes_in_between_holds() -> None:
    robots = Robots("stopped", over(), STOP)
    robots.on_mission = lambda: [(TOLD, Stop(LATER, time.time_ns(), "now"))]
    drive, _ = driven(robots, resume=True)
    assert drive.reasons == ["Not started: another operator said stop or resume meanwhile."]
    assert robots.of(Resume) == []


@pytest.mark.parametrize(
    ("history", "why"),
    [
        ((over(), STOP), "were told to stop at"),
        ((over()._replace(duration_ns=90_000 * S),), "two is driving already"),
        ((over()._replace(digest="0123456789abcdef"),), "read another fleet file"),
    ],
)
def test_what_stands_in_the_way_ends_it_before_a_word(history: tuple[Any, ...], why: str) -> None:
    robots = Robots("stopped", *history)
    drive, _ = driven(robots)
    (reason,) = drive.reasons
    assert reason.startswith("Not started: ")
    assert why in reason
    assert {type(message) for message, _ in robots.said} == {Ask}


def test_a_stop_that_nobody_lifted_during_a_drive_holds_beyond_it() -> None:
    """Else the next drive would take it for that of the regular end, and lift it."""
    robots = Robots("ready")
    robots.on_mission = lambda: [(TOLD, Stop(LATER, time.time_ns(), "a person"))]
    drive, _ = driven(robots)
    assert drive.reasons == []
    stop = robots.of(Stop)[-1]
    assert stop.reason == "a person"
    assert stop.version > LATER
    lifted = Robots("ready")
    lifted.on_mission = lambda: [
        (TOLD, Stop(LATER, time.time_ns(), "a person")),
        (TOLD, Resume(LATER + 1, time.time_ns(), ())),
    ]
    driven(lifted)
    assert lifted.of(Stop)[-1].reason == OVER


def test_a_drive_that_failed_but_came_to_its_end_leaves_no_stop_behind_that_somebody_meant() -> None:
    robots = Robots("ready")
    drive, _ = driven(robots, orders=[order("join", robot=1, edges=(2,))])
    (reason,) = drive.reasons
    assert reason.startswith("The order at 0 s (join) was not given: ")
    assert robots.of(Stop)[-1].reason == OVER


@pytest.mark.parametrize("interrupts", [0, 1])
def test_who_is_not_heard_to_stop_is_named(interrupts: int) -> None:
    robots, interrupt = Robots("ready"), Interrupt()
    robots.deaf = {2}
    if interrupts:
        robots.on_mission = partial(interrupted, interrupt)
    drive, _ = driven(robots, interrupt=interrupt)
    assert drive.reasons == ["Not heard to stop: robot 2."]
    stops = robots.of(Stop)
    assert stops[0].reason == ("interrupted" if interrupts else OVER)
    assert len(stops) > 5  # again and again, until it is given up


def test_robots_that_refuse_the_mission_end_the_drive_before_its_epoch() -> None:
    robots = Robots("ready")
    robots.refuses = {2}
    drive, _ = driven(robots)
    assert drive.reasons == ["Not driven: this is not the fleet file that is read by robot 2."]
    mission = robots.of(Mission)[0]
    assert robots.of(Stop)[0].time_ns < mission.epoch_ns


def test_a_drive_that_another_has_taken_over_stops_nobody() -> None:
    robots = Robots("ready")
    theirs = over()._replace(version=LATER, epoch_ns=time.time_ns() + 9 * S)
    robots.on_mission = lambda: [(key_expressions.mission("two"), theirs)]
    drive, _ = driven(robots)
    assert drive.reasons == ["Another operator has begun another drive, and the robots drive that."]
    assert robots.of(Stop) == []


def test_a_dead_mans_switch_is_held_as_long_as_the_drive_lasts() -> None:
    robots = Robots("ready")
    fleet = replace(FLEET, supervision=replace(FLEET.supervision, deadman_s=1.0))
    driven(robots, fleet=fleet)
    kinds = [type(message) for message, _ in robots.said]
    assert kinds.index(Heartbeat) < kinds.index(Mission)
    assert len(robots.of(Heartbeat)) >= 4  # ten a second


def test_an_interrupt_before_the_mission_says_nothing() -> None:
    interrupt = Interrupt()
    interrupt.count = 1
    robots = Robots("ready")
    driven(robots, interrupt=interrupt)
    assert robots.said == []


def test_left_to_themselves_robots_get_no_stop() -> None:
    robots = Robots("stopped", over(), Stop(5, 100 * S, OVER))
    robots.late_s = {1: 0.1, 2: 0.2}
    drive, _ = driven(robots, detach=True, duration_s=30.0)
    assert drive.reasons == []
    assert drive.end_ns == robots.of(Mission)[0].epoch_ns + 30 * S
    assert robots.of(Resume)
    assert robots.of(Stop) == []


class Gone(StringIO):
    """An output whose reader is gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


def test_an_output_that_is_gone_keeps_no_stop_from_being_said() -> None:
    """As when Ctrl-C also ends what the output is piped into."""
    robots, interrupt = Robots("ready"), Interrupt()
    robots.on_mission = partial(interrupted, interrupt)
    driven(robots, interrupt=interrupt, stream=Gone())
    assert {stop.reason for stop in robots.of(Stop)} == {"interrupted"}


def interrupted(interrupt: Interrupt) -> list[tuple[str, Message]]:
    interrupt.count, interrupt.number = 1, 2
    return []


def test_the_stop_is_said_before_a_word_about_it() -> None:
    robots, interrupt = Robots("ready"), Interrupt()
    robots.on_mission = partial(interrupted, interrupt)

    class Late(StringIO):
        def write(self, text: str) -> int:
            assert "stopping every robot" not in text or robots.of(Stop)
            return super().write(text)

    _, said = driven(robots, interrupt=interrupt, stream=Late())
    assert "SIGINT: stopping every robot" in said


def test_a_drive_that_breaks_off_leaves_a_stop_that_nobody_lifts_without_a_word() -> None:
    robots = Robots("ready")

    def broken() -> list[tuple[str, Message]]:
        raise ZeroDivisionError

    robots.on_mission = broken
    with pytest.raises(ZeroDivisionError):
        driven(robots)
    assert {stop.reason for stop in robots.of(Stop)} == {BROKEN_OFF}
    assert refusal(known(robots.of(Stop)[-1]), time.time_ns(), resume=False, given_ns=time.time_ns())


@pytest.mark.parametrize("last", [Mission, Stop])
def test_a_recording_that_fails_ends_the_drive_but_not_its_stop(last: type[Any]) -> None:
    """It is said again and again, and who does not hear it is named, whenever the disk was full."""
    robots = Robots("ready")
    robots.deaf = {2}
    stream = StringIO()

    def record(_now_ns: int, _key: str, payload: bytes) -> Message | None:
        if robots.of(last):
            raise RecordingError("the disk is full")
        return valid(payload)

    with pytest.raises(RecordingError, match="the disk is full"):
        driven(robots, record=record, stream=stream)
    stops = robots.of(Stop)
    assert len(stops) > 5
    assert {stop.reason for stop in stops} == {BROKEN_OFF if last is Mission else OVER}
    assert stream.getvalue().splitlines()[-1] == "Not heard to stop: robot 2."


def test_a_robot_that_boasts_of_what_cannot_be_keeps_no_drive_from_starting() -> None:
    robots = Robots("ready")
    robots.boasts = {2: (2**61, 2**61)}
    drive, _ = driven(robots)
    assert drive.reasons == []
    assert robots.of(Mission)[0].version < 2**60


def test_a_robot_that_tells_of_what_nobody_says_is_named() -> None:
    robots = Robots("ready")
    robots.boasts = {2: (0, time.time_ns() // 1_000)}
    drive, _ = driven(robots, timing=replace(QUICK, ready_s=1.2, ready_per_process_s=0.0))
    assert drive.reasons == [
        "Not ready within 1 s: robot 2 says that something was ordered, and nobody relays it."
    ]
    assert len(robots.of(Ask)) >= 2
    assert robots.of(Mission) == []


def test_a_plant_that_is_gone_knows_no_mission() -> None:
    robots = Robots("ready")
    robots.gone = {2}
    robots.late_s = {1: 0.3, 2: 0.0}
    drive, _ = driven(robots, detach=True, duration_s=30.0, timing=replace(QUICK, hand_over_ns=0))
    assert drive.reasons[0] == "Not left to drive alone: robot 2 did not take the mission."
    assert not drive.is_left
    assert robots.of(Stop)


def known(*orders: Stop) -> Operator:
    made = Operator(FLEET, resolve(FLEET))
    for each in orders:
        made.hear(TOLD, each)
    return made


def test_robots_that_somebody_stops_meanwhile_are_not_said_to_drive_on() -> None:
    """The command may have been frozen since it gave the mission."""
    robots = Robots("ready")
    robots.on_mission = lambda: [(TOLD, Stop(LATER, time.time_ns(), "a person"))]
    drive, _ = driven(robots, detach=True, duration_s=30.0)
    assert not drive.is_left
    (reason,) = drive.reasons
    assert reason.startswith("Not left to drive alone: the robots were told to stop at ")
    assert reason.endswith(": a person.")
    assert ": a person" in robots.of(Stop)[-1].reason


@pytest.mark.parametrize(
    ("epoch_ns", "due_ns"),
    [
        (None, SHOW_PERIOD_NS),  # no mission yet
        (NS_PER_S, SHOW_PERIOD_NS),  # one that begins later than the next look
        (0, SHOW_FIRST_NS),
        (NS_PER_S // 20, NS_PER_S // 20 + SHOW_FIRST_NS),
        (-SHOW_FIRST_NS, SHOW_PERIOD_NS),  # one that has been shown
    ],
)
def test_a_fleet_is_shown_as_soon_as_it_can_be_heard_to_drive(epoch_ns: int | None, due_ns: int) -> None:
    now_ns, drive = 7 * NS_PER_S, object.__new__(Drive)
    state: Any = SimpleNamespace(epoch_ns=None if epoch_ns is None else now_ns + epoch_ns)
    drive._fleet_state = state
    assert drive._next_show_ns(now_ns) - now_ns == due_ns


class ByRules(Attached):
    """Robots of whose processes rules may dispose: notes what is done to them, and when."""

    def __init__(self, fleet: Fleet, now_ns: Callable[[], int]) -> None:
        super().__init__(fleet)
        self.done: list[tuple[str, int]] = []
        self._now_ns = now_ns

    def carry_out(self, action: Action, pose: Pose | None) -> bool:
        assert pose is not None
        self.done.append((action.what, self._now_ns()))
        return True


def test_what_rules_do_is_done_at_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that only sleeping moves: how late a busy machine wakes a process up is not the drive's."""
    now_ns = [time.time_ns()]

    def sleep(time_s: float) -> None:
        now_ns[0] += max(1_000, round(time_s * S))

    clock = SimpleNamespace(now_ns=lambda: now_ns[0])
    monkeypatch.setattr("handfast.deploy.drive.fleet_state.RealClock", lambda: clock)
    of_drive = SimpleNamespace(sleep=sleep, time_ns=clock.now_ns, monotonic=lambda: now_ns[0] / S)
    monkeypatch.setattr("handfast.deploy.drive.drive.time", of_drive)
    rules = (
        Rule(name="crash", robot=2, kill="agent", at=0.513, duration=0.0171),
        Rule(name="again", robot=1, restart="plant", at=0.61),
    )
    fleet = replace(FLEET, faults=replace(FLEET.faults, rules=rules))
    processes = ByRules(fleet, clock.now_ns)
    drive, said = driven(Robots("ready"), fleet=fleet, processes=processes, duration_s=0.9)
    assert drive.reasons == []
    assert "0.5 s: rule 'crash' killed robot 2's agent" in said
    epoch_ns = drive.end_ns - 9 * S // 10
    late_us = [
        (what, (at_ns - epoch_ns) // 1_000 - due_us)
        for (what, at_ns), due_us in zip(processes.done, (513_000, 530_100, 610_000, 610_000), strict=True)
    ]
    assert [what for what, _ in late_us] == ["kill", "start", "kill", "start"]
    assert all(0 <= late < 5 for _, late in late_us), late_us


def test_after_a_stand_of_the_command_what_waited_for_it_is_not_shown_as_what_is() -> None:
    """As after Ctrl-Z: messages from before come first."""
    drive, _ = driven(Robots("ready"))
    stands: list[int] = []
    drive._watch.stood = lambda: stands.append(now_ns)  # type: ignore[method-assign]
    now_ns = drive._stepped_ns
    for gap_ns, shown_ns in (
        (NS_PER_S // 20, 0),
        (STOOD_NS + 1, FRESH_NS),
        (STOOD_NS + 1, 0),  # on a machine where each step takes so long something has to be shown
        (NS_PER_S // 20, 0),
        (9 * NS_PER_S, FRESH_NS),
    ):
        now_ns += gap_ns
        drive._show_due_ns = now_ns
        drive._look_after_a_stand(now_ns)
        assert drive._show_due_ns - now_ns == shown_ns
    assert len(stands) == 2


FLOOD = 65_536
"""An inbox full of messages."""


class Flood(Robots):
    """Of whom more comes than the machine has time for.

    Attributes:
        taken: how much of it has been recorded.
        pause_s: how long each takes; 0: no more comes.
        on_flood: what happens with each of it.
    """

    taken = 0
    pause_s = 0.0005
    on_flood: Callable[[], None] = staticmethod(lambda: None)

    def drain(self) -> Iterator[tuple[str, bytes]]:
        yield from super().drain()
        if self._given is not None and self.pause_s:
            yield from [(TOLD, b"")] * FLOOD

    def record(self, _now_ns: int, _key: str, payload: bytes) -> Message | None:
        if payload:
            return valid(payload)
        self.taken += 1
        self.on_flood()
        time.sleep(self.pause_s)
        return None


@pytest.mark.slow
def test_a_drive_of_which_more_comes_than_there_is_time_for_ends_at_its_end() -> None:
    robots = Flood("ready")
    drive, said = driven(robots, record=robots.record)
    assert 0 < robots.taken < FLOOD
    assert {stop.reason for stop in robots.of(Stop)} == {OVER}
    (warning,) = drive.warnings
    assert warning == "The command did not keep up with what it heard: the last of it is not recorded"
    assert f"warning: {warning}" in said
    assert drive.is_behind
    robots.pause_s = 0.0
    drive.take_rest()
    assert not drive.is_behind
    assert robots.taken == FLOOD


def test_ctrl_c_is_heard_while_more_comes_than_there_is_time_for() -> None:
    robots, interrupt = Flood("ready"), Interrupt()

    def interrupted() -> None:
        interrupt.count, interrupt.number = 1, signal.SIGINT

    robots.on_flood = interrupted
    driven(robots, record=robots.record, duration_s=60.0, interrupt=interrupt)
    assert 0 < robots.taken < FLOOD
    assert {stop.reason for stop in robots.of(Stop)} == {"interrupted"}
