"""The plant on the bus: it obeys a fresh wrench and brakes in any other case."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pytest

from handfast.agent.common.time import NS_PER_S, MachineClock
from handfast.agent.control.hand import Pose
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest, load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.trickle_timer import SequenceNumbers
from handfast.agent.messages.types import (
    ACTS_PERIODS,
    FUTURE_NS_MAX,
    TEXT_MAX,
    Checks,
    HandState,
    Mission,
    PlantState,
    Resume,
    StatusText,
    Stop,
    Wrench,
)
from handfast.deploy.console.data_files import FLEETS
from handfast.plant.backend import COAST, Check, Command, PlantBackend, Reading, Said
from handfast.plant.node import CHECKS_PERIOD_NS, PlantNode
from handfast.plant.unicycle import from_fleet
from tests.wire import opened, sealed

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0%s }, { id = 2, x_m = 2, y_m = 0 }]
fleet = { name = "two", rate_hz = 50 }
formation = { edges = [[1, 2]], distance_m = 1.0, safe_distance_m = 0.2 }
control = { wrench_timeout_s = 0.1 }
faults = { rule = [%s] }
"""
T0 = 1000 * NS_PER_S
PERIOD = 20_000_000
TIMEOUT = 100_000_000
WRENCH_KEY = "two/robot/1/plant/wrench"
STATE_KEY = "two/robot/1/plant/state"
TRUTH_KEY = "two/robot/1/plant/truth"
MISSION_KEY = "two/mission"
STOP_KEY, RESUME_KEY, TOLD_KEY = "two/stop", "two/resume", "two/robot/1/told"
CHECKS_KEY = "two/robot/1/plant/checks"
TEXT_KEY = "two/robot/1/plant/statustext"
REST = Pose(0.0, 0.0, 0.0, 0.0, 0.0)


def fleet(robot: str = "", faults: str = "") -> Fleet:
    return parse_fleet(FLEET % (robot, faults), source="here")


class Call(NamedTuple):
    now_ns: int
    command: Command | None


class Backend(PlantBackend):
    """Remembers what it was asked for, and gives the reading it was given."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self.pose = REST
        self.healthy, self.obeying, self.note = True, True, ""
        self.clearances = 0
        self.told: Sequence[Check] = ()
        self.asked: tuple[float, float] | None = None

    def step(self, now_ns: int, command: Command | None) -> Reading:
        self.calls.append(Call(now_ns, command))
        force, torque = command or (0.0, 0.0)
        said = self.healthy, self.note, self.obeying, self.asked
        return Reading(now_ns - 7, self.pose, force, torque, *said)

    def close(self) -> None: ...

    def clear_to_drive(self) -> None:
        self.clearances += 1

    def checks(self, now_ns: int) -> Sequence[Check]:
        return self.told


@pytest.fixture
def backend() -> Backend:
    return Backend()


@pytest.fixture
def node(backend: Backend) -> PlantNode:
    return PlantNode(fleet(), 1, backend)


def wrench(
    time_ns: int, force: float = 3.0, torque: float = 0.2, brake: bool = False, robot: int = 1
) -> bytes:
    return encode(Wrench(robot, 0, time_ns, force, torque, brake))


def state(node: PlantNode, now_ns: int) -> PlantState:
    (key, payload), *_ = node.tick(now_ns)
    assert key == STATE_KEY
    message = decode(payload)
    assert isinstance(message, PlantState)
    return message


def test_keys_and_ticks(node: PlantNode):
    assert node.subscriptions == (STOP_KEY, RESUME_KEY, TOLD_KEY, WRENCH_KEY, MISSION_KEY, "two/faults")
    links = "two/robot/1/plant/links"
    faults = "two/robot/1/plant/faults"
    assert node.publications == (STATE_KEY, TRUTH_KEY, CHECKS_KEY, TEXT_KEY, links, faults)
    assert node.alive_keys == (key_expressions.alive("two", 1, "plant"),) == ("two/alive/robot/1/plant",)
    assert (node.period_ns, node.phase_ns) == (PERIOD, 0)
    agents = Agent(resolved(fleet()), 1).publications
    assert {*node.publications, *agents} == set(key_expressions.published("two", 1))  # what links let through


class Speaking(Backend):
    """A body that has something to say."""

    def __init__(self, *said: Said) -> None:
        super().__init__()
        self.said = said

    def status_texts(self) -> Sequence[Said]:
        said, self.said = self.said, ()
        return said


def test_what_the_vehicle_says_is_passed_on_once(node: PlantNode) -> None:
    assert not [key for key, _ in node.tick(T0) if key == TEXT_KEY]  # a simulated one says nothing
    body = Speaking(Said("critical", "EKF failsafe"), Said("info", "x" * 2 * TEXT_MAX))
    speaking = PlantNode(fleet(), 1, body)
    first, second = (decode(payload) for key, payload in speaking.tick(T0) if key == TEXT_KEY)
    assert first == StatusText(1, 0, T0, "critical", "EKF failsafe")
    assert isinstance(second, StatusText)
    assert (second.sequence, second.severity, len(second.text)) == (1, "info", TEXT_MAX)
    assert not [key for key, _ in speaking.tick(T0 + PERIOD) if key == TEXT_KEY]
    body.said = (Said("info", "armed"),)
    (again,) = (decode(payload) for key, payload in speaking.tick(T0 + 2 * PERIOD) if key == TEXT_KEY)
    assert again == StatusText(1, 2, T0 + 2 * PERIOD, "info", "armed")


def test_obeys_a_fresh_wrench(node: PlantNode, backend: Backend):
    node.receive(T0, WRENCH_KEY, wrench(T0 - 1))
    told = state(node, T0)
    assert backend.calls[-1].command == Command(3.0, 0.2)
    assert (told.driving, told.force, told.torque) == (True, 3.0, 0.2)
    assert node.condition == ("driving", "")


def test_tells_what_its_body_told(node: PlantNode, backend: Backend):
    backend.pose = Pose(1.0, 2.0, 3.0, 4.0, 5.0)
    backend.healthy, backend.note = False, "no estimate"
    first, second = state(node, T0), state(node, T0 + PERIOD)
    assert first == PlantState(
        1, 0, T0 - 7, 1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, False, False, True, "no estimate"
    )
    assert (second.sequence, second.time_ns) == (1, T0 + PERIOD - 7)
    backend.asked = 0.5, -0.25
    assert state(node, T0 + 2 * PERIOD).asked == ((0.5, -0.25),)


def test_watchdog_brakes_when_the_wrench_is_stale_and_drives_when_a_fresh_one_comes(
    node: PlantNode, backend: Backend
):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    told = state(node, T0 + TIMEOUT)
    assert backend.calls[-1].command is not None  # just in time
    assert told.driving
    told = state(node, T0 + TIMEOUT + 1)
    assert backend.calls[-1].command is None
    assert not told.driving
    assert node.condition == ("braking", "no fresh wrench for 0.10 s")
    node.late(T0 + TIMEOUT + 2, TIMEOUT // 2)  # it brakes whatever the reason, and says that
    assert not state(node, T0 + TIMEOUT + 2).driving
    assert node.condition == ("braking", "overloaded: this machine ran late by 0.05 s")
    assert not state(node, T0 + TIMEOUT + 3).driving
    assert node.condition == ("braking", "no fresh wrench for 0.10 s")
    node.receive(T0 + NS_PER_S, WRENCH_KEY, wrench(T0 + NS_PER_S, force=1.0))
    assert state(node, T0 + NS_PER_S).driving
    assert backend.calls[-1].command == Command(1.0, 0.2)


@pytest.mark.parametrize("step", [0, 1, 2])
def test_a_wrench_acts_no_longer_than_twice_what_it_is_meant_to(
    node: PlantNode, backend: Backend, step: int
) -> None:
    """Until a fresh one comes, or it brakes, the body goes on as it goes: a torque that acts on spins it."""
    node._timeout_ns = NS_PER_S
    acts = ACTS_PERIODS << step
    for late in (0, 3):  # since it came, however late that was
        begin_ns = T0 + late * NS_PER_S
        node.receive(
            begin_ns, WRENCH_KEY, encode(Wrench(1, 0, begin_ns - late * PERIOD, 3.0, 0.2, False, (), step))
        )
        for k in range(acts + 5):
            told = state(node, begin_ns + k * PERIOD)
            assert backend.calls[-1].command == (Command(3.0, 0.2) if k < acts else COAST)
            assert told.driving


def test_obeys_a_wrench_that_brakes(node: PlantNode, backend: Backend):
    node.receive(T0, WRENCH_KEY, wrench(T0 - 2))
    node.receive(T0, WRENCH_KEY, wrench(T0 - 1, force=50.0, brake=True))
    assert not state(node, T0).driving
    assert backend.calls[-1].command is None
    assert node.condition == ("braking", "its agent brakes")


@pytest.mark.parametrize(
    ("key", "payload", "reason"),
    [
        (WRENCH_KEY, wrench(T0), "out_of_order"),
        (WRENCH_KEY, wrench(T0 - 1), "out_of_order"),
        (WRENCH_KEY, wrench(T0 + FUTURE_NS_MAX + PERIOD + 1), "future"),
        (WRENCH_KEY, wrench(T0 + 2, robot=2), "wrong_key"),
        ("two/robot/2/plant/wrench", wrench(T0 + 2), "wrong_key"),
        (STATE_KEY, wrench(T0 + 2), "wrong_key"),
        (WRENCH_KEY, encode(HandState(1, 0, T0 + 2, True, 1, *[0.0] * 11, (), ())), "wrong_key"),
        (WRENCH_KEY, b"", "checksum"),
        (WRENCH_KEY, b"\xff" * 20_000, "oversized"),
        (WRENCH_KEY, wrench(T0 + 2)[:-1], "checksum"),
        (WRENCH_KEY, sealed(opened(wrench(T0 + 2))[:-1]), "malformed"),
        (WRENCH_KEY, wrench(T0 + 2, force=float("nan")), "not_finite"),
        (WRENCH_KEY, wrench(T0 + 2, torque=float("inf")), "not_finite"),
        (WRENCH_KEY, wrench(T0 + 2, robot=0), "range"),
        (WRENCH_KEY, sealed(b"\x98\x02" + opened(wrench(T0 + 2))[2:]), "version"),
    ],
)
def test_anything_else_is_counted_and_changes_nothing(
    node: PlantNode, backend: Backend, key: str, payload: bytes, reason: str
):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    node.receive(T0 + PERIOD, key, payload)
    assert dict(node.rejected) == {reason: 1}
    assert state(node, T0 + PERIOD).driving
    assert backend.calls[-1].command == Command(3.0, 0.2)
    state(node, T0 + TIMEOUT + 1)
    assert backend.calls[-1].command is None  # the watchdog was not fed either


def test_of_several_wrenches_the_newest_counts(node: PlantNode, backend: Backend):
    for stamp, force in ((T0 + 3, 3.0), (T0 + 9, 9.0), (T0 + 6, 6.0)):
        node.receive(T0 + PERIOD, WRENCH_KEY, wrench(stamp, force))
    state(node, T0 + PERIOD)
    assert backend.calls[-1].command == Command(9.0, 0.2)
    assert dict(node.rejected) == {"out_of_order": 1}


# ---------------------------------------------------------------------- its operator, and leave to drive


def test_a_body_that_its_operator_has_does_not_drive_whatever_the_wrench(node: PlantNode, backend: Backend):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    backend.obeying, backend.note = False, "mode MANUAL"
    told = state(node, T0)
    assert (told.driving, told.healthy, told.obeying, told.note) == (False, True, False, "mode MANUAL")
    assert backend.calls[-1].command == Command(3.0, 0.2)  # whether it may have it, its backend knows
    backend.healthy, backend.note = False, "no estimate"
    told = state(node, T0 + PERIOD)
    assert (told.driving, told.healthy, told.obeying) == (False, False, False)
    backend.healthy, backend.obeying, backend.note = True, True, ""
    assert state(node, T0 + 2 * PERIOD).driving


def test_ending_does_not_wait_for_a_body_that_somebody_else_drives(node: PlantNode, backend: Backend):
    backend.pose, backend.obeying = REST._replace(speed=0.5), False
    state(node, T0)
    assert not node.done
    node.end()
    assert node.done


def mission(version: int, of: str = "", epoch_ns: int = T0 + NS_PER_S) -> bytes:
    return encode(Mission(version, T0, epoch_ns, 60 * NS_PER_S, of or digest(fleet())))


def resume(version: int, *robots: int) -> bytes:
    return encode(Resume(version, T0, robots))


def test_a_mission_is_leave_to_drive_once(node: PlantNode, backend: Backend):
    """`run` says it until all have it, and to whoever starts again: that is no new leave."""
    for now in (T0, T0 + 1, T0 + 2):
        node.receive(now, MISSION_KEY, mission(4))
    node.receive(T0 + 3, MISSION_KEY, mission(3))
    assert backend.clearances == 1
    node.receive(T0 + 4, MISSION_KEY, mission(5))  # another formation of the same drive: no leave either
    assert backend.clearances == 1
    node.receive(T0 + 5, MISSION_KEY, mission(6, epoch_ns=T0 + 9 * NS_PER_S))
    assert backend.clearances == 2
    assert not node.rejected


@pytest.mark.parametrize("robots", [(), (1,), (2, 1)])
def test_leave_to_resume_is_taken_once(node: PlantNode, backend: Backend, robots: tuple[int, ...]):
    node.receive(T0, RESUME_KEY, resume(7, *robots))
    node.receive(T0 + 1, RESUME_KEY, resume(7, *robots))
    assert backend.clearances == 1
    node.receive(T0 + 2, RESUME_KEY, resume(8, *robots))
    assert backend.clearances == 2
    assert not node.rejected


def test_leave_to_resume_for_others_is_not_for_this_one(node: PlantNode, backend: Backend):
    node.receive(T0, RESUME_KEY, resume(7, 2))
    node.receive(T0, RESUME_KEY, resume(8, 2, 11, 9999))
    assert backend.clearances == 0
    assert not node.rejected
    node.receive(T0 + 1, RESUME_KEY, resume(7, 1))  # of another operator, who counts for himself
    assert backend.clearances == 1


@pytest.fixture
def vehicle(backend: Backend) -> PlantNode:
    """Of the bundled rovers, in its first tick at `T0`."""
    made = PlantNode(ROVERS, 1, backend)
    made.tick(T0)
    return made


ROVERS = resolved(load_fleet(FLEETS / "rovers.toml"))
BEFORE, AFTER = T0 - NS_PER_S, T0 + NS_PER_S


@pytest.mark.parametrize("key", ["rovers/mission", "rovers/robot/1/told"])
def test_a_drive_that_began_before_its_process_is_no_leave_for_a_vehicle(
    vehicle: PlantNode, backend: Backend, key: str
):
    """Its operator may have had it, and given it back, before anybody here looked."""

    def said(version: int, time_ns: int, epoch_ns: int) -> bytes:
        return encode(Mission(version, time_ns, epoch_ns, 60 * NS_PER_S, digest(ROVERS)))

    vehicle.receive(AFTER, key, said(4, BEFORE, BEFORE))
    vehicle.receive(AFTER, key, said(5, AFTER, BEFORE))  # changed since
    vehicle.receive(AFTER, key, said(6, BEFORE, AFTER))  # said before, to begin then
    assert backend.clearances == 0
    vehicle.receive(AFTER, key, said(7, AFTER, AFTER + 1))
    assert backend.clearances == 1
    assert not vehicle.rejected


@pytest.mark.parametrize("key", ["rovers/resume", "rovers/robot/1/told"])
def test_a_resume_of_before_its_process_is_no_leave_for_a_vehicle(
    vehicle: PlantNode, backend: Backend, key: str
):
    """An operator says it again to who has not heard it, and robots to each other."""

    def said(version: int, time_ns: int) -> bytes:
        return encode(Resume(version, time_ns, ()))

    vehicle.receive(AFTER, "rovers/stop", encode(Stop(6, BEFORE, "a stop that was resumed")))
    vehicle.receive(AFTER, key, said(7, BEFORE))
    vehicle.receive(AFTER, key, said(7, BEFORE))
    assert backend.clearances == 0
    vehicle.receive(AFTER, "rovers/robot/1/plant/wrench", wrench(AFTER))
    vehicle.tick(AFTER)
    assert vehicle.condition == ("driving", ""), "it does end the stop of then"
    vehicle.receive(AFTER, key, said(8, AFTER))
    assert backend.clearances == 1
    assert not vehicle.rejected


def test_of_a_body_that_its_operator_has_it_says_so_but_of_a_stop_first(node: PlantNode, backend: Backend):
    backend.obeying, backend.note = False, "its operator has it: mode HOLD"
    node.receive(T0, WRENCH_KEY, wrench(T0, brake=True))
    state(node, T0)
    assert node.condition == ("released", "its operator has it: mode HOLD")
    node.receive(T0, STOP_KEY, stop(3, "lunch"))
    state(node, T0 + PERIOD)
    assert node.condition == ("braking", "stop: lunch")


def stop(version: int, reason: str = "") -> bytes:
    return encode(Stop(version, T0, reason))


def test_a_stop_brakes_the_plant_whatever_its_agent_says(node: PlantNode, backend: Backend):
    """A stop must not hang on one process."""
    node.receive(T0, WRENCH_KEY, wrench(T0))
    assert state(node, T0).driving
    node.receive(T0 + PERIOD, STOP_KEY, stop(3, "somebody in the way"))
    for tick in range(1, 20):
        now = T0 + tick * PERIOD
        node.receive(now, WRENCH_KEY, wrench(now))
        assert not state(node, now).driving
        assert backend.calls[-1].command is None
    assert node.condition == ("braking", "stop: somebody in the way")
    node.receive(now, STOP_KEY, stop(2, "older"))
    node.receive(now, RESUME_KEY, resume(3))  # of equal versions the stop holds
    node.receive(now, RESUME_KEY, resume(4, 2))  # for another robot
    node.receive(now, MISSION_KEY, mission(9))  # a mission does not end it
    assert not state(node, now).driving
    node.receive(now, RESUME_KEY, resume(5))
    assert state(node, now).driving
    assert dict(node.rejected) == {"out_of_order": 1}
    node.receive(now, STOP_KEY, stop(4))  # the leave was given after it
    assert state(node, now).driving


def test_what_its_agent_tells_is_as_good_as_an_operators_word(node: PlantNode, backend: Backend):
    node.receive(T0, TOLD_KEY, stop(7))
    node.receive(T0, WRENCH_KEY, wrench(T0))
    assert not state(node, T0).driving
    node.receive(T0, TOLD_KEY, resume(8))
    node.receive(T0, TOLD_KEY, mission(9))
    assert state(node, T0).driving
    assert backend.clearances == 2
    assert not node.rejected


def test_a_plant_that_starts_in_a_stop_does_not_drive(node: PlantNode):
    node.receive(T0, STOP_KEY, stop(0))
    node.receive(T0, WRENCH_KEY, wrench(T0))
    assert not state(node, T0).driving
    assert node.condition == ("braking", "stop")


# ---------------------------------------------------------------------- checks

GPS = Check("gps", "warning", "fix 3D", "wait for more satellites")
MODE = Check("mode", "blocking", "MANUAL", "set GUIDED")


def checks(node: PlantNode, now_ns: int) -> Checks | None:
    found = [decode(payload) for key, payload in node.tick(now_ns) if key == CHECKS_KEY]
    assert len(found) <= 1
    if not found:
        return None
    assert isinstance(found[0], Checks)
    return found[0]


def test_checks_are_told_at_once_when_they_change_and_every_second(node: PlantNode, backend: Backend):
    assert checks(node, T0) is None  # a body of which there is nothing to say
    backend.told = [GPS]
    now = T0 + PERIOD
    assert checks(node, now) == Checks(1, 0, now, (GPS,))
    while now < T0 + CHECKS_PERIOD_NS:
        now += PERIOD
        assert checks(node, now) is None
    now += PERIOD
    assert checks(node, now) == Checks(1, 1, now, (GPS,))
    backend.told = (GPS, MODE)
    now += PERIOD
    assert checks(node, now) == Checks(1, 2, now, (GPS, MODE))
    for k in range(CHECKS_PERIOD_NS // PERIOD - 1):  # a second after the change
        now += PERIOD
        backend.told = (GPS._replace(found=f"{k} satellites"), MODE)  # a figure is no change
        assert checks(node, now) is None
    now += PERIOD
    assert checks(node, now) == Checks(1, 3, now, tuple(backend.told))
    backend.told = (GPS._replace(level="ok"), MODE)
    now += PERIOD
    assert checks(node, now) == Checks(1, 4, now, tuple(backend.told))


# ---------------------------------------------------------------------- measurements


@pytest.mark.parametrize(
    ("robot", "faults", "told"),
    [
        ("", "", [STATE_KEY]),
        (", heading_noise_rad = 0.01", "", [STATE_KEY, TRUTH_KEY]),
        # A rule may begin to hold at any time: its truth is told from the start on.
        ("", "{ robot = 1, at = 5, heading_bias_rad = 0.1 }", [STATE_KEY, TRUTH_KEY]),
        ("", "{ robot = 2, heading_bias_rad = 0.1 }", [STATE_KEY]),
        ("", "{ heading_bias_rad = 0.1 }", [STATE_KEY, TRUTH_KEY]),
        ("", "{ robot = 1, tick_jitter = 0.001 }", [STATE_KEY]),
    ],
)
def test_truth_is_told_only_while_a_measurement_may_differ(robot: str, faults: str, told: list[str]):
    made = fleet(robot, faults)
    assert [key for key, _ in PlantNode(made, 1, from_fleet(made, 1)).tick(T0)] == told


def test_ending_brakes_whatever_the_agent_says_and_is_done_at_rest(node: PlantNode, backend: Backend):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    backend.pose = REST._replace(speed=0.5)
    assert state(node, T0).driving
    assert not node.done
    node.end()
    assert not state(node, T0 + PERIOD).driving
    assert backend.calls[-1].command is None
    assert node.condition == ("braking", "the plant was told to end")
    assert not node.done
    backend.pose = REST._replace(yaw_rate=0.3)
    state(node, T0 + 2 * PERIOD)
    assert not node.done
    backend.pose = REST
    state(node, T0 + 3 * PERIOD)
    assert node.done


def test_a_body_without_its_agent_comes_to_rest():
    made = fleet()
    node = PlantNode(made, 1, from_fleet(made, 1))
    now = T0
    for _ in range(20):
        node.receive(now, WRENCH_KEY, wrench(now, force=20.0, torque=0.05))
        told = state(node, now)
        now += PERIOD
    assert told.speed > 0.5
    for _ in range(100):
        told = state(node, now)
        now += PERIOD
    assert (told.speed, told.yaw_rate) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert not told.driving


# ---------------------------------------------------------------------- the agent's clock

HOUR = 3600 * NS_PER_S
T1 = T0 + 9 * HOUR
MONOTONIC = 77 * NS_PER_S
"""The machine's at T1 by the plant's clock."""


def wrench_by(clock: MachineClock, time_ns: int, force: float = 3.0) -> bytes:
    return encode(Wrench(1, 0, time_ns, force, 0.2, False, tuple(clock)))


@pytest.mark.parametrize("ahead_ns", [HOUR, -HOUR, 130_000_007])
def test_on_the_bus_a_plant_goes_by_its_agents_clock(node: PlantNode, backend: Backend, ahead_ns: int):
    """`ahead_ns`: of the plant's clock, which the body goes on being stepped by."""
    node.runs_by(MachineClock(5, T1 - MONOTONIC))
    agents = MachineClock(5, T1 - MONOTONIC - ahead_ns)
    mission = Mission(1, T1, T1 - HOUR, 9 * HOUR, digest(fleet()))
    node.receive(T1, MISSION_KEY, encode(mission))
    for tick in range(20):
        now_ns = T1 + tick * PERIOD
        node.receive(now_ns, WRENCH_KEY, wrench_by(agents, now_ns - ahead_ns - PERIOD // 2))
        told = state(node, now_ns)
        assert told.driving
        assert told.time_ns == now_ns - 7 - ahead_ns
        assert backend.calls[-1] == (now_ns, (3.0, 0.2))
    numbers = SequenceNumbers(PERIOD)
    numbers.begin(mission.epoch_ns)
    assert told.sequence == numbers.at(told.time_ns)
    assert (T1 - ahead_ns - (T1 - node.phase_ns)) % PERIOD == 0  # its ticks are on the agent's grid
    after = state(node, now_ns + TIMEOUT + PERIOD)
    assert not after.driving
    assert node.condition == ("braking", "no fresh wrench for 0.13 s")


@pytest.mark.parametrize("ahead_ns", [HOUR, -HOUR])
def test_what_waits_on_a_link_waits_no_longer_for_a_clock_that_is_followed(backend: Backend, ahead_ns: int):
    node = PlantNode(fleet(faults='{ topic = "wrench", delay = 0.05 }'), 1, backend)
    node.runs_by(MachineClock(5, T1 - MONOTONIC))
    node.receive(T1, WRENCH_KEY, wrench_by(MachineClock(5, T1 - MONOTONIC), T1))
    node._follow((5, T1 - MONOTONIC - ahead_ns))
    assert not state(node, T1 + 2 * PERIOD).driving
    assert node._ingress._links._pending
    node.tick(T1 + 3 * PERIOD)
    assert node._ingress._links._pending == []
