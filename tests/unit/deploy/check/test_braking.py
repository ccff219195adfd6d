"""What `handfast check` says of robots that cannot brake as the safety filter counts on."""

from __future__ import annotations

import pytest

from handfast.agent.control.limits import barrier_rate
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.check.braking import check_braking
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep import run
from tests.unit.agent.fleet.fleet_texts import small

SLOW = ("control.max_acceleration=1.2", "control.max_speed_mps=1.5")


def found(fleet: Fleet) -> dict[str, Finding]:
    findings = list(check_braking(fleet))
    assert len({finding.place for finding in findings}) == len(findings)
    assert all(finding.level == "warning" for finding in findings)
    return {finding.place: finding for finding in findings}


def test_what_follows_from_the_rest_is_sound() -> None:
    assert found(small()) == found(small(*SLOW)) == {}


@pytest.mark.parametrize("name", ["delta", "lattice45", "line10", "pair", "reserve", "rovers"])
def test_bundled_fleets_can_brake(name: str) -> None:
    findings = check(load_fleet(FLEETS / f"{name}.toml"))
    assert [finding for finding in findings if finding.level != "info"] == []


def test_a_body_that_goes_on_for_long_without_its_agent() -> None:
    long = found(small("control.wrench_timeout_s=1"))["control.wrench_timeout_s"]
    assert "1 s: for so long a body goes on as it last went while its agent is late" in long.message
    assert "leaves room for 0.67 s" in long.message
    assert "take 0.666 s or less" in long.message
    assert found(small("control.wrench_timeout_s=0.666")) == {}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("robot.7.max_force_n=9.9", "robot 7 cannot brake {} max_force_n of robot 7 allows 1.1;"),
        (
            "robot_defaults.max_torque_nm=1.3",
            "robots 3, 7 and 5 cannot brake {} max_torque_nm of robot 5 allows 0.999;",
        ),
    ],
)
def test_a_body_that_is_too_weak(override: str, words: str) -> None:
    body = (
        "robot_defaults.hand_offset_m=0.1",
        "robot_defaults.inertia_kgm2=0.13",
        "robot.5.hand_offset_m=0.0999",
    )
    weak = (*SLOW, *body, override)
    text = found(small(*weak))["control.max_acceleration"].message
    begin, end = words.split("{}")
    assert text.startswith(begin)
    assert end in text
    assert "that takes 1.2 m/s2" in text
    rate = text.split("set it to ")[1].split()[0]
    assert found(small(*weak, f"control.max_acceleration={rate}")) == {}
    assert found(small(*weak, f"control.max_acceleration={float(rate) + 0.01}")) != {}


def test_vehicles_by_what_their_bridges_ask_of_them() -> None:
    rovers, weak = FLEETS / "rovers.toml", "robot.4.mavlink.max_acceleration=0.5"
    assert barrier_rate(load_fleet(rovers)) == pytest.approx(0.8 / 0.9)
    text = found(load_fleet(rovers, (weak,)))["control.max_acceleration"].message
    assert text.startswith("robot 4 cannot brake")
    assert "mavlink.max_acceleration of robot 4 allows 0.5; set it to 0.5 or less" in text
    assert found(load_fleet(rovers, (weak, "robot.4.plant=unicycle"))) == {}


DRIVING = ("trajectory.kind=line", "trajectory.velocity_mps=[0, 0.3]")


def places(apart: float, *overrides: str) -> Fleet:
    """Two robots, one `apart` (m) ahead of the other along y, at 0.3 m/s along y."""
    shape = (
        "formation.edges=[[1, 2]]",
        f"formation.distance_m={apart}",
        f"formation.offsets=[[0, 0], [0, {apart}]]",
    )
    return load_fleet(FLEETS / "pair.toml", (*shape, *DRIVING, *overrides))


def room(fleet: Fleet) -> dict[str, Finding]:
    return {finding.place: finding for finding in check(fleet) if finding.level != "info"}


def test_places_between_which_one_cannot_follow_another() -> None:
    assert room(places(0.37)) == {}
    text = room(places(0.32))["trajectory.velocity_mps"].message
    assert "0.3 m/s is too fast for robots 1 and 2, whose places are 0.32 m apart" in text
    assert "keeps it 0.37 m behind" in text
    assert "take at most 0.15 m/s" in text
    assert room(places(0.32, "trajectory.velocity_mps=[0, -0.1499]")) == {}
    assert room(places(0.32, "trajectory.velocity_mps=[0.3, 0]")) == {}  # side by side
    assert room(places(0.32, "avoidance.enabled=false")) == {}


def test_the_pair_that_is_warned_of_drives_so_far_apart() -> None:
    fleet = places(0.32, "fleet.duration_s=25")
    a = analyse(run.drive(fleet), resolve(fleet))
    assert float(a.distances[-1, 0]) == pytest.approx(0.37, abs=1e-3)


def suddenly(apart: float) -> Fleet:
    """The same at 0.7 m/s, every message a second late; the first one's plant dies for two."""
    dies = 'faults.rule=[{name = "dies", robot = 2, kill = "plant", at = 8.0, for = 2.0}]'
    late = ("trajectory.velocity_mps=[0, 0.7]", "control.max_acceleration=2", "faults.delay=1s", dies)
    return places(apart, "formation.safe_distance_m=0.4", "fleet.duration_s=15", *late)


def test_places_between_which_one_that_stands_suddenly_is_heard_of_too_late() -> None:
    text = room(suddenly(1.15))["faults.delay"].message
    assert "who follows it needs 1.59 m, and robots 1 and 2 are 1.15 m apart" in text
    assert "take at most 0.448 m/s" in text
    for apart, is_safe in ((1.15, False), (1.6, True)):
        fleet = suddenly(apart)
        assert ("faults.delay" not in room(fleet)) == is_safe
        closest = analyse(run.drive(fleet), resolve(fleet)).closest
        assert closest is not None
        assert (closest.distance_m > 0.4) == is_safe


def test_places_nearer_than_the_last_stage_lets_robots_come() -> None:
    text = room(places(0.25))["avoidance.margin_m"].message
    assert (
        "robots 1 and 2 have places 0.25 m apart, and the safety filter keeps robots 0.27 m from each other"
        in text
    )
    assert "avoidance.margin_m" not in room(places(0.27))


def test_a_margin_that_does_not_allow_for_the_actuators_lag() -> None:
    lags = ("robot_defaults.actuator_lag_s=0.01", "robot.5.actuator_lag_s=0.08")
    text = found(small(*SLOW, *lags))["avoidance.margin_m"].message
    assert "0.05 m does not allow for actuator_lag_s = 0.08 s of robot 5, in which it goes 0.12 m" in text
    assert "take 0.17 m" in text
    assert found(small(*SLOW, *lags, "avoidance.margin_m=0.17")) == {}
    assert found(small(*SLOW, lags[0])) == {}
    assert found(small(*SLOW, *lags, "avoidance.enabled=false")) == {}
