"""handfast.agent.supervision.situation: what the state machine decides by."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.controller import Controller
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import LISTEN_BEACONS
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.messages.types import PlantState, Removed, Resume, Stop
from handfast.agent.supervision.neighbour_trust import NeighbourTrust
from handfast.agent.supervision.orders import AWAITED
from handfast.agent.supervision.overload import Overload
from handfast.agent.supervision.situation import NOT_SAID, Situation
from handfast.agent.supervision.state_machine import DRIVING, MISSION_OVER, State
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.orders.mission_editing import first_mission

pytestmark = pytest.mark.patches

NOW = 1_700_000_000 * NS_PER_S


class Trust:
    """What a robot thinks of its neighbours."""

    hold = degraded = ""
    lacks = ""

    def missing(self, now_ns: int, *, started: bool) -> str:
        return self.lacks


def situation(*overrides: str) -> tuple[Situation, Trust]:
    fleet = resolved(load_fleet(FLEETS / "pair.toml", overrides))
    trust = Trust()
    controller, overload = Controller(fleet, resolve(fleet), 1), Overload(0, fleet.period_ns, NS_PER_S // 4)
    made = Situation(fleet, 1, controller, cast(NeighbourTrust, trust), overload)
    return made, trust


def driving(*overrides: str) -> tuple[Situation, Trust]:
    """One in the middle of a mission, with all that it needs."""
    made, trust = situation(*overrides)
    fleet = resolved(load_fleet(FLEETS / "pair.toml", overrides))
    made.mission = first_mission(fleet, NOW, NOW, NOW - NS_PER_S, 60 * NS_PER_S)
    made.may_go_on = True
    made.accept_plant(plant(), NOW)
    made.check_plant(NOW - NS_PER_S)  # its first tick
    made.check_plant(NOW)
    return made, trust


def plant(**changes: Any) -> PlantState:
    still = {"speed": 0.0, "yaw_rate": 0.0, "driving": True}
    given = {"time_ns": NOW, "healthy": True, "obeying": True, "note": ""} | still | changes
    return cast(PlantState, SimpleNamespace(**given))


def test_in_the_middle_of_a_mission_all_is_well() -> None:
    made, _ = driving()
    conditions = made.conditions(NOW, State.RUNNING)
    assert conditions.all_well
    assert conditions.started
    assert conditions[:9] == ("",) * 9


@pytest.mark.parametrize(
    ("later_s", "changes", "trouble"),
    [
        (0.0, {}, ""),
        (9.0, {}, "plant silent for 9.00 s"),
        (0.0, {"healthy": False, "note": "GPS lost"}, "plant unhealthy: GPS lost"),
        (0.0, {"healthy": False}, "plant unhealthy: no reason given"),
    ],
)
def test_trouble_with_the_plant_is_said(later_s: float, changes: dict[str, Any], trouble: str) -> None:
    made, _ = driving()
    made.plant = plant(**changes)
    made.check_plant(NOW + round(later_s * NS_PER_S))
    assert made.plant_trouble == trouble


def test_a_plant_of_another_clock_is_told_from_one_that_is_silent() -> None:
    made, _ = situation()
    made.accept_plant(plant(time_ns=NOW + 9 * NS_PER_S), NOW)
    made.check_plant(NOW)
    assert made.plant_trouble == "for its plant, whose clock is 9.00 s ahead"
    made.accept_plant(plant(time_ns=NOW - 9 * NS_PER_S), NOW)
    made.check_plant(NOW)
    assert made.plant_trouble == "plant late by 9.00 s, or its clock is behind"
    made.check_plant(NOW + NS_PER_S)
    assert made.plant_trouble == "plant silent for 10.00 s"


@pytest.mark.parametrize(
    ("after_ns", "reason"), [(1, None), (0, "duplicate"), (-1, "out_of_order"), (3600 * NS_PER_S, "future")]
)
def test_only_a_newer_state_of_the_plant_is_taken(after_ns: int, reason: str | None) -> None:
    made, _ = driving()
    newer = plant(time_ns=NOW + after_ns)
    assert made.accept_plant(newer, NOW) == reason
    assert (made.plant is newer) == (reason is None)


def test_a_body_that_was_taken_away_is_waited_for_though_its_plant_forgot() -> None:
    made, _ = driving()
    made.plant = plant(obeying=False, note="mode HOLD")
    assert made.conditions(NOW, State.RUNNING).body == "mode HOLD"
    made.check_plant(NOW + 9 * NS_PER_S)
    made.lost_plant(State.RELEASED)
    made.plant = plant()  # started again
    assert made.conditions(NOW, State.FAULT).body.endswith(AWAITED)
    made.latch.accept_resume(Resume(NOW + 1, NOW + 1, ()))
    assert made.conditions(NOW, State.FAULT).body == ""


def test_stop_wins_over_the_end_of_the_mission_and_the_end_of_the_process_over_both() -> None:
    made, _ = driving()
    mission = made.mission
    assert mission is not None
    after = NOW + mission.duration_ns + NS_PER_S
    assert made.conditions(after, State.RUNNING).stop == MISSION_OVER
    made.latch.accept_stop(Stop(NOW + 2, NOW + 2, "lunch"))
    assert "lunch" in made.conditions(after, State.RUNNING).stop
    made.ending = True
    assert made.conditions(NOW, State.RUNNING).stop == "the agent was told to end"


def test_it_has_ended_when_it_stands_or_nothing_can_be_known_of_it() -> None:
    made, _ = driving()
    assert not made.ended
    made.ending = True
    assert made.ended
    made.plant = cast(PlantState, SimpleNamespace(**vars(plant()) | {"speed": 1.0}))
    assert not made.ended
    made.plant_trouble = "plant silent for 1.00 s"
    assert made.ended


def test_the_dead_mans_switch_holds_until_a_heartbeat_and_after_the_last() -> None:
    made, _ = driving("supervision.deadman_s=1")
    assert made.conditions(NOW, State.RUNNING).hold == "no operator's heartbeat"
    made.heartbeat_ns = NOW
    assert made.conditions(NOW + NS_PER_S, State.RUNNING).hold == ""
    assert made.conditions(NOW + 2 * NS_PER_S, State.RUNNING).hold == "no operator's heartbeat for 2.0 s"


def test_a_body_that_runs_away_is_no_plant_to_drive() -> None:
    """By its speed, or by how fast its hand goes round it."""
    most = load_fleet(FLEETS / "pair.toml").control.max_speed_mps
    for speed, yaw_rate, obeying, trouble in (
        (1.9 * most, 0.0, True, ""),
        (
            2.5 * most,
            0.0,
            True,
            f"its body runs away: {2.5 * most:.2f} m/s, control.max_speed_mps is {most:g}",
        ),
        (
            -2.5 * most,
            0.0,
            True,
            f"its body runs away: {2.5 * most:.2f} m/s, control.max_speed_mps is {most:g}",
        ),
        (
            0.0,
            100.0 * most,
            True,
            f"its body runs away: {10.0 * most:.2f} m/s, control.max_speed_mps is {most:g}",
        ),
        (2.5 * most, 0.0, False, ""),  # its operator drives it
    ):
        made, _ = driving()
        state = plant(time_ns=NOW + 1, obeying=obeying, speed=speed, yaw_rate=yaw_rate)
        assert made.accept_plant(state, NOW + 1) is None
        made.check_plant(NOW + 1)
        assert made.plant_trouble == trouble
    unfiltered, _ = driving("avoidance.enabled=false")
    unfiltered.accept_plant(plant(time_ns=NOW + 1, speed=9.0 * most), NOW + 1)
    unfiltered.check_plant(NOW + 1)
    assert unfiltered.plant_trouble == ""


@pytest.mark.parametrize(("level", "spins"), [(0, False), (3, True)])
def test_a_body_that_turns_too_far_between_two_decisions_is_braked(level: int, spins: bool) -> None:
    """What steers it at the full rate throws it about at a lower one."""
    made, _ = driving()
    made._controller.keep_pace(made._fleet.period_ns << level, 1.0)
    state = plant(time_ns=NOW + 1, yaw_rate=-6.5)
    assert made.accept_plant(state, NOW + 1) is None
    made.check_plant(NOW + 1)
    why = "its body spins: 6.5 rad/s are too fast to be steered at 6.25 Hz"
    assert made.plant_trouble == (why if spins else "")


def test_a_plant_that_hears_no_wrench_is_named() -> None:
    """It tells of itself, and brakes: the way to it is dead, the way back is not."""
    made, trust = driving()
    assert made.conditions(NOW, State.RUNNING).degraded == ""
    trust.degraded = "slower: robot 2"
    late = NOW + 2 * NS_PER_S
    made.accept_plant(plant(time_ns=late, driving=False), late)
    told = "slower: robot 2; its plant has taken no wrench for 2.0 s"
    assert made.conditions(late, State.RUNNING).degraded == told
    for state, changes in (
        (State.HOLDING, {"driving": False}),
        (State.RUNNING, {}),
        (State.RUNNING, {"obeying": False}),
    ):
        made.accept_plant(plant(time_ns=late + 1, **changes), late)
        made.plant = plant(time_ns=late, **changes)
        assert made.conditions(late, state).degraded == "slower: robot 2"


def test_a_plant_that_brakes_for_want_of_wrenches_lets_its_robot_down_at_once() -> None:
    made, _ = driving()
    for k, (drives, state, lets_down) in enumerate(
        (
            (False, State.RUNNING, False),  # it has not taken the first one yet
            (True, State.RUNNING, False),
            (False, State.RUNNING, True),
            (True, State.RUNNING, False),
            (False, State.HOLDING, False),
        ),
        start=1,
    ):
        made.accept_plant(plant(time_ns=NOW + k, driving=drives), NOW + k)
        made.conditions(NOW + k, state)
        assert made.is_let_down is lets_down


def test_who_comes_into_a_drive_listens_first() -> None:
    made, trust = driving()
    made.check_plant(NOW)
    made_of = resolved(load_fleet(FLEETS / "pair.toml"))
    controller = Controller(made_of, resolve(made_of), 1)
    overload = Overload(0, made_of.period_ns, NS_PER_S // 4)
    fresh = Situation(made_of, 1, controller, cast(NeighbourTrust, Trust()), overload)
    fresh.mission = made.mission
    fresh.check_plant(NOW)
    assert fresh.conditions(NOW, State.WAITING).neighbours == "hears who is near"
    later = NOW + LISTEN_BEACONS * NS_PER_S
    lost = "nobody heard tells where to look for robot 2"
    assert fresh.conditions(later, State.WAITING).neighbours == lost
    controller.peers.remove([Removed(2, later)])
    assert fresh.conditions(later, State.WAITING).neighbours == ""
    trust.lacks = "silent neighbours: robot 2"
    assert made.conditions(later, State.WAITING).neighbours == trust.lacks


def test_neighbours_to_begin_with_are_no_matter_of_a_robot_that_drives() -> None:
    made, trust = driving()
    trust.lacks = "silent neighbours: robot 2"
    for state in DRIVING:
        assert made.conditions(NOW, state).all_well


def test_a_mission_of_before_the_start_waits_for_somebodys_word() -> None:
    made, _ = driving()
    made.may_go_on = False
    conditions = made.conditions(NOW, State.READY)
    assert (conditions.started, conditions.mission) == (False, NOT_SAID)
    made.may_go_on = True
    conditions = made.conditions(NOW, State.READY)
    assert (conditions.started, conditions.mission) == (True, "")


def test_a_plant_that_may_have_spoken_while_the_own_process_stood_is_not_lost() -> None:
    made, _ = driving()
    later = NOW + NS_PER_S
    made._overload.late(later, NS_PER_S - 1_000_000)
    made.check_plant(later)
    stood = "overloaded: this machine ran late by 1 s"
    assert made.plant_trouble == stood  # its place is not known
    conditions = made.conditions(later, State.RUNNING)
    assert (conditions.plant, conditions.hold) == ("", stood)
    assert made.conditions(later, State.WAITING).plant == stood
    made.lost_plant(State.RELEASED)
    assert made.body_trouble == ""
    made.check_plant(later + 300_000_000)  # by now it would have been heard
    assert made.plant_trouble == "plant silent for 1.30 s"
    assert made.conditions(later, State.RUNNING).plant == made.plant_trouble


def test_what_of_a_plant_waited_for_the_own_process_is_not_late_nor_its_clock_behind() -> None:
    made, _ = driving()
    later = NOW + 2 * NS_PER_S
    made._overload.late(later, NS_PER_S + NS_PER_S // 2)  # the plant had fallen silent before
    made.accept_plant(plant(time_ns=NOW + 1), later)
    made.check_plant(later)
    assert made.plant_trouble == "overloaded: this machine ran late by 1.5 s"
    made._overload.late(later + NS_PER_S, NS_PER_S // 10)
    made.accept_plant(plant(time_ns=NOW + NS_PER_S), later + NS_PER_S)
    made.check_plant(later + 3 * NS_PER_S)
    assert made.plant_trouble == "plant silent for 4.00 s"
