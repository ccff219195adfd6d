"""A rover that nothing commands any more rolls on for three seconds: others keep away from all of that way.

Found by a stranger: a link that was cut while the formation came about brought two rovers to 0.4 m of each
other, where 1 m is safe; its neighbours took it that it braked. Then by killing each of the bundled rovers
every half second, alone and with its agent: it turns while it rolls, and who only brakes before it is hit.
"""

from __future__ import annotations

from math import hypot
from pathlib import Path
from typing import Final, cast

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control import hand
from handfast.agent.control.peers.rolling import ROLL_ERROR, rolled, rolls_of
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.sweep.run import drive as simulate
from handfast.plant.backend import VirtualBody
from tests.chaos.run import drive
from tests.rover_drive import driven

DURATION_S = 14.0
LONG_S = 18.0
DOWN_S = 5
SCENES: Final = Path(__file__).parent / "scenes"


def killed(robot: int, what: str, at: float, more: str = "", *, for_good: bool = False) -> Fleet:
    """The bundled rovers; what is killed of one of them is there again `DOWN_S` later, or never."""
    lasts, duration_s = ("", LONG_S) if for_good else (f"for = {DOWN_S}\n", DURATION_S)
    rule = f'\n[[faults.rule]]\nrobot = {robot}\nkill = "{what}"\nat = {at}\n{lasts}'
    text = (FLEETS / "rovers.toml").read_text(encoding="utf-8") + rule + more
    return resolved(parse_fleet(text, source="here", overrides=[f"fleet.duration_s={duration_s}"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "what", "at"),
    [
        (3, "plant", 2.0), (2, "both", 2.0),
        *(pytest.param(*each, marks=pytest.mark.long) for each in (
            (4, "plant", 3.0), (4, "plant", 6.0), (2, "plant", 2.0),
            (4, "both", 1.5), (1, "both", 1.0), (4, "both", 1.0), (5, "both", 1.5),
        )),
    ],
)  # fmt: skip
def test_a_bridge_that_is_killed_while_they_come_together(robot: int, what: str, at: float) -> None:
    fleet = killed(robot, what, at)
    assert driven(fleet).pairs.min() >= fleet.formation.safe_distance_m


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "at", "cut_at"),
    [("plant", 1.7, 2.4), ("plant", 1.8, 2.7), ("plant", 1.5, 2.2), ("both", 1.8, 2.3)],
)
def test_one_that_is_cut_off_gets_out_of_the_way_of_whom_it_knew_to_be_lost(
    what: str, at: float, cut_at: float
) -> None:
    """A stranger's find: robot 3 heard nobody, took all for lost alike, and found no way out between them."""
    cut = f'\n[[faults.rule]]\npartition = "alone 3"\nat = {cut_at}\nfor = 4\n'
    fleet = killed(2, what, at, cut)
    assert driven(fleet).pairs.min() >= fleet.formation.safe_distance_m


MISSES = {
    "cut off": '[[faults.rule]]\npartition = "alone 3"\nat = 0.16\nfor = 4\n',
    "starts again": '[[faults.rule]]\nrobot = 3\nkill = "agent"\nat = 3\nfor = 0.5\n',
    "not there": '[[faults.rule]]\nrobot = 3\nkill = "agent"\nat = 0.5\nfor = 4\n',
}


@pytest.mark.slow
@pytest.mark.parametrize("misses", MISSES)
@pytest.mark.parametrize("what", ["plant", "both"])
def test_one_that_did_not_hear_it_move_goes_round_it_later(what: str, misses: str) -> None:
    """A stranger's find: told by others of a way that was wide enough for all, it drove out of that, and
    through the body: 0.05 m."""
    fleet = killed(1, what, 1.1 if misses == "cut off" else 1.5, MISSES[misses], for_good=True)
    assert driven(fleet).pairs.min() >= fleet.formation.safe_distance_m


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "from_s"), [("rows", 5.0), ("stopped", 4.0), ("turning", 3.0)])
def test_who_drives_at_one_that_is_lost_gets_out_of_its_way(scene: str, from_s: float) -> None:
    """A stranger's finds: it drove back in front of it, too slowly, and was run over: 0.70 to 0.82 m."""
    fleet = resolved(load_fleet(SCENES / f"head_on_{scene}.toml"))
    found = driven(fleet)
    assert found.pairs.min() >= fleet.formation.safe_distance_m
    assert (found.pairs[found.times > from_s].min(axis=0) < 2.0).any(), "they do meet"


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "at"), [(1, 1.0), (2, 2.0), (3, 2.0), (4, 2.0), (5, 2.0), (6, 4.0)])
def test_it_rolls_to_where_it_said(robot: int, at: float) -> None:
    fleet = killed(robot, "both", at)
    simulation = Simulation(fleet)
    assert simulation.start(round(DURATION_S * NS_PER_S)), simulation.reasons
    simulation.run_until(simulation.epoch_ns + round(at * NS_PER_S))
    neighbour = next(
        other for edge in fleet.formation.edges if robot in edge for other in edge if other != robot
    )
    (agent,) = (agent for agent in simulation.agents if agent.robot == neighbour)
    said = agent._peers.get(robot).message
    assert said is not None
    simulation.run_until(simulation.epoch_ns + round((at + DOWN_S + 0.5) * NS_PER_S))
    body = cast(VirtualBody, simulation.plants[robot - 1]._backend)
    rests = hand.hand(body.pose, fleet.robot(robot).hand_offset_m)
    rolls = rolls_of(fleet.robot(robot))
    assert rolls is not None
    expected = rolled(said.x, said.y, said.obeys[0], rolls.reach, rolls.for_s)
    assert hypot(rests.x - expected.x, rests.y - expected.y) < ROLL_ERROR


TWO = """
robot = [{ id = 1, x_m = 5.4, y_m = 0.0, heading_rad = 3.1 }, { id = 2, x_m = -1.0, y_m = 0.0 }]
datum = { latitude_deg = -35.363261, longitude_deg = 149.16523 }
fleet = { name = "two", rate_hz = 10, duration_s = 12 }
formation = { edges = [[1, 2]], offsets = [[-3.1, 0.0], [3.1, 0.3]], safe_distance_m = 1.0, assign = false }
trajectory = { kind = "hold" }

[control]
kp = 1.0
c1 = 0.6
c2 = 1.0
kd = 1.8
k2 = 5.0
max_speed_mps = 1.0
max_acceleration = 0.8
plant_timeout_s = 0.5
wrench_timeout_s = 0.25

[robot_defaults]
plant = "mavlink"
mass_kg = 20.0
inertia_kgm2 = 1.2
hand_offset_m = 0.4
mavlink = { connection = "simulator", max_speed_mps = 1.0, max_acceleration = 0.8, max_yaw_rate_radps = 1.0 }
"""
"""They change sides, and so drive at each other."""


@pytest.mark.slow
@pytest.mark.parametrize("at", [2.2, 2.5, 2.81])
def test_one_that_holds_because_it_hears_nobody_gets_out_of_the_way(at: float) -> None:
    """A stranger's find: alone it only braked, and was rolled over."""
    rule = f'[[faults.rule]]\nrobot = 1\nkill = "both"\nat = {at}\nfor = 6\n'
    fleet = resolved(parse_fleet(f"{TWO}\n{rule}", source="here"))
    assert driven(fleet).pairs.min() >= fleet.formation.safe_distance_m


@pytest.mark.slow
def test_it_says_whose_way_it_gets_out_of() -> None:
    rule = '[[faults.rule]]\nrobot = 1\nkill = "plant"\nat = 2.2\n'
    recording = simulate(resolved(parse_fleet(f"{TWO}\n{rule}", source="here")))
    status = recording.robots[2].status
    says = "gets out of the way of robot 1, which nothing commands"
    told = [t_s for t_s, reason in zip(status.t.tolist(), status.reasons, strict=True) if says in reason]
    assert 2.7 < told[0] < 3.1, "once its plant is missed"
    assert told[-1] < 6.0, "no longer than that rolls"


@pytest.mark.slow
def test_a_fast_rover_that_is_stopped_and_brakes_as_it_can_has_obeyed() -> None:
    """A stranger's find: in virtual time its lags were taken for disobedience."""
    orders = '[[order]]\nat = 6\nkind = "stop"\n[[order]]\nat = 8\nkind = "resume"\n'
    text = (FLEETS / "rovers.toml").read_text(encoding="utf-8").replace("duration_s = 60", "duration_s = 14")
    outcome = drive(text + orders)
    assert "stopped" in outcome.checked
    assert outcome.violations == ()
