"""The plant on the bus: it obeys a fresh wrench and brakes in any other case."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from agent import keys
from agent.clock import NS_PER_S
from agent.fleet import Fleet, digest, parse_fleet
from agent.hand import Pose
from agent.messages import Faults, HandState, Mission, PlantState, Wrench, decode, encode
from agent.neighbours import FUTURE_NS_MAX
from plant.backend import Command, Reading
from plant.node import PlantNode
from plant.unicycle import from_fleet
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
REST = Pose(0.0, 0.0, 0.0, 0.0, 0.0)


def fleet(robot: str = "", faults: str = "") -> Fleet:
    return parse_fleet(FLEET % (robot, faults), source="here")


class Call(NamedTuple):
    now_ns: int
    command: Command | None


class Backend:
    """Remembers what it was asked for, and gives the reading it was given."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self.pose = REST
        self.healthy, self.note = True, ""

    def step(self, now_ns: int, command: Command | None) -> Reading:
        self.calls.append(Call(now_ns, command))
        force, torque = command or (0.0, 0.0)
        return Reading(now_ns - 7, self.pose, force, torque, self.healthy, self.note)

    def close(self) -> None: ...


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
    assert node.subscriptions == (WRENCH_KEY, MISSION_KEY, "two/faults")
    links = "two/robot/1/plant/links"
    assert node.publications == (STATE_KEY, TRUTH_KEY, links, "two/robot/1/plant/faults")
    assert node.alive_key == keys.alive("two", 1, "plant") == "two/alive/robot/1/plant"
    assert (node.period_ns, node.phase_ns) == (PERIOD, 0)


def test_brakes_until_it_has_a_wrench(node: PlantNode, backend: Backend):
    told = state(node, T0)
    assert backend.calls == [Call(T0, None)]
    assert not told.driving
    assert node.condition == ("braking", "no wrench yet")


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
    assert first == PlantState(1, 0, T0 - 7, 1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0, False, False, "no estimate")
    assert (second.sequence, second.time_ns) == (1, T0 + PERIOD - 7)


def test_watchdog_brakes_when_the_wrench_is_stale_and_drives_when_a_fresh_one_comes(
    node: PlantNode, backend: Backend
):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    state(node, T0 + TIMEOUT)
    assert backend.calls[-1].command == Command(3.0, 0.2)  # just in time
    told = state(node, T0 + TIMEOUT + 1)
    assert backend.calls[-1].command is None
    assert not told.driving
    assert node.condition == ("braking", "no fresh wrench for 0.10 s")
    node.receive(T0 + NS_PER_S, WRENCH_KEY, wrench(T0 + NS_PER_S, force=1.0))
    assert state(node, T0 + NS_PER_S).driving
    assert backend.calls[-1].command == Command(1.0, 0.2)


def test_a_wrench_that_is_stale_when_it_comes_does_nothing(node: PlantNode, backend: Backend):
    node.receive(T0 + NS_PER_S, WRENCH_KEY, wrench(T0))
    assert not state(node, T0 + NS_PER_S).driving


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
        (WRENCH_KEY, encode(HandState(1, 0, T0 + 2, True, *[0.0] * 8, (), ())), "wrong_key"),
        (WRENCH_KEY, b"", "checksum"),
        (WRENCH_KEY, b"\xff" * 20_000, "oversized"),
        (WRENCH_KEY, wrench(T0 + 2)[:-1], "checksum"),
        (WRENCH_KEY, sealed(opened(wrench(T0 + 2))[:-1]), "malformed"),
        (WRENCH_KEY, wrench(T0 + 2, force=float("nan")), "not_finite"),
        (WRENCH_KEY, wrench(T0 + 2, torque=float("inf")), "not_finite"),
        (WRENCH_KEY, wrench(T0 + 2, robot=0), "range"),
        (WRENCH_KEY, sealed(b"\x98\x03" + opened(wrench(T0 + 2))[2:]), "version"),
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


# ---------------------------------------------------------------------- measurements


@pytest.mark.parametrize(
    ("robot", "faults", "told"),
    [
        ("", "", [STATE_KEY]),
        (", heading_noise_rad = 0.01", "", [STATE_KEY, TRUTH_KEY]),
        # A rule may begin to hold at any time: its truth is told from the start on.
        ("", "{ robot = 1, at = 5, speed_bias_mps = 0.1 }", [STATE_KEY, TRUTH_KEY]),
        ("", "{ robot = 2, speed_bias_mps = 0.1 }", [STATE_KEY]),
        ("", "{ speed_bias_mps = 0.1 }", [STATE_KEY, TRUTH_KEY]),
        ("", "{ robot = 1, tick_jitter = 0.001 }", [STATE_KEY]),
        ("", "{ robot = 1, dropout = 1 }", [TRUTH_KEY]),
    ],
)
def test_truth_is_told_only_while_a_measurement_may_differ(robot: str, faults: str, told: list[str]):
    made = fleet(robot, faults)
    assert [key for key, _ in PlantNode(made, 1, from_fleet(made, 1)).tick(T0)] == told


def test_measured_state_and_truth_differ_in_the_pose_alone(backend: Backend):
    backend.pose = Pose(1.0, 2.0, 3.0, 0.0, 0.0)
    node = PlantNode(fleet(faults="{ position_bias_m = [0.5, -0.25], heading_bias_rad = 0.125 }"), 1, backend)
    (_, measured), (_, truth) = node.tick(T0)
    told = decode(truth)
    assert isinstance(told, PlantState)
    assert told[3:8] == backend.pose
    assert decode(measured) == told._replace(x=1.5, y=1.75, heading=3.125)


def test_faults_of_measurements_hold_by_the_stamp_of_the_state(backend: Backend):
    made = fleet(faults="{ robot = 1, at = 1, for = 1, speed_bias_mps = 0.5 }")
    node = PlantNode(made, 1, backend)
    node.receive(T0, MISSION_KEY, encode(Mission(1, T0, T0, 60 * NS_PER_S, digest(made))))
    assert state(node, T0).speed == 0.0
    assert state(node, T0 + NS_PER_S).speed == 0.0  # the reading is 7 ns older
    assert state(node, T0 + NS_PER_S + PERIOD).speed == 0.5
    assert state(node, T0 + 2 * NS_PER_S).speed == 0.5
    assert state(node, T0 + 2 * NS_PER_S + PERIOD).speed == 0.0


def test_live_faults_of_measurements_come_and_go(node: PlantNode):
    assert [key for key, _ in node.tick(T0)] == [STATE_KEY]
    rules = "[[faults.rule]]\nrobot = 1\ndropout = 1"
    live = Faults(1, T0, "ana@lab:1", T0, NS_PER_S, rules)
    node.receive(T0, keys.faults("two"), encode(live))
    assert TRUTH_KEY in [key for key, _ in node.tick(T0 + PERIOD)]
    assert STATE_KEY not in [key for key, _ in node.tick(T0 + 2 * PERIOD)]
    node.tick(T0 + NS_PER_S)  # finds that the lease is over
    assert [key for key, _ in node.tick(T0 + NS_PER_S + PERIOD)] == [STATE_KEY]


def test_a_measurement_that_is_not_taken_leaves_a_gap_in_the_numbers(backend: Backend):
    node = PlantNode(fleet(faults="{ robot = 1, dropout = 0.5 }"), 1, backend)
    numbers = []
    for tick in range(40):
        for key, payload in node.tick(T0 + tick * PERIOD):
            if key == STATE_KEY:
                message = decode(payload)
                assert isinstance(message, PlantState)
                assert message.time_ns == T0 + tick * PERIOD - 7
                numbers.append((tick, message.sequence))
    assert all(tick == sequence for tick, sequence in numbers)
    assert 10 < len(numbers) < 30


def test_leaving_brakes_whatever_the_agent_says_and_is_done_at_rest(node: PlantNode, backend: Backend):
    node.receive(T0, WRENCH_KEY, wrench(T0))
    backend.pose = REST._replace(speed=0.5)
    assert state(node, T0).driving
    assert not node.done
    node.leave()
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


def test_noise_does_not_keep_a_body_from_standing(backend: Backend):
    node = PlantNode(fleet(", speed_noise_mps = 5"), 1, backend)
    node.leave()
    assert abs(state(node, T0).speed) > 0.1
    assert node.done


def test_missed_ticks_are_counted(node: PlantNode):
    node.timed(1000, 0)
    node.timed(1000, 3)
    node.timed(1000, 2)
    assert node.overruns == 5


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
