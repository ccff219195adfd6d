"""`handfast stop`: who is known to brake, and how fast."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import PlantState, Status
from handfast.deploy.orders.stop_outcome import STOPS_OUTDONE_MAX, Stopping
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square

FLEET = square()
MS = S // 1000
VERSION = EPOCH // 1_000


def stopping(reason: str = "") -> Stopping:
    return Stopping(FLEET, EPOCH, reason)


def agent(
    made: Stopping, robot: int, after_ms: int, state: str, orders: int | None = None, reason: str = ""
) -> None:
    version = made.message.version if orders is None else orders
    status = Status(robot, 1, EPOCH, state, "", reason, 1, version, (), (), (), ())
    made.feed(EPOCH + after_ms * MS, key_expressions.status("square", robot), status)


def plant(made: Stopping, robot: int, after_ms: int, *, driving: bool) -> None:
    state = PlantState(robot, 1, EPOCH, *[0.0] * 7, driving, True, True, "")
    made.feed(EPOCH + after_ms * MS, key_expressions.plant_state("square", robot), state)


def brake(made: Stopping, *robots: int) -> None:
    for robot in robots:
        agent(made, robot, 20, "stopping")
        plant(made, robot, 30, driving=False)


def test_it_is_done_when_every_agent_and_plant_brakes() -> None:
    made = stopping("a person")
    assert (made.message.version, made.message.reason) == (VERSION, "a person")
    brake(made, *FLEET.ids[:-1])
    assert not made.done
    agent(made, 8, 25, "running", 0)
    plant(made, 8, 30, driving=True)
    assert not made.done
    assert made.outcome(8) == "robot 8: running: its agent has not taken the stop, its plant does not brake"
    agent(made, 8, 40, "stopping")
    assert not made.done
    plant(made, 8, 50, driving=False)
    plant(made, 8, 70, driving=False)
    agent(made, 8, 90, "stopped")
    assert made.done
    assert made.outcome(8) == "robot 8: stopped after 40 ms, its plant brakes after 50 ms (over a new link)"


@pytest.mark.parametrize("state", ["stopped", "standby", "fault"])
def test_states_in_which_a_stop_changes_nothing_count_once_it_was_heard(state: str) -> None:
    made = stopping()
    brake(made, *FLEET.ids[1:])
    plant(made, 1, 10, driving=False)
    agent(made, 1, 10, state, VERSION - 1)
    assert not made.done
    agent(made, 1, 20, state)
    assert made.done


def test_who_does_not_answer_is_named() -> None:
    made = stopping()
    assert made.outcome(3) == "robot 3: nothing heard from its agent, nothing heard from its plant"
    made.feed(
        EPOCH,
        key_expressions.status("square", 2),
        Status(3, 1, EPOCH, "stopped", "", "", 1, 9, (), (), (), ()),
    )
    assert "nothing heard from its agent" in made.outcome(3), "on another robot's key"


def test_a_later_leave_that_an_agent_knew_before_is_outdone() -> None:
    """As when this machine's clock is behind that of the operator who gave it."""
    made = stopping()
    agent(made, 1, 10, "running", VERSION + 500)
    assert made.message.version == VERSION + 501
    brake(made, *FLEET.ids)
    assert made.done
    agent(made, 2, 20, "stopping", VERSION)
    assert not made.done, "it has taken the first one only"


def test_a_leave_that_is_given_after_it_is_not() -> None:
    made = stopping()
    brake(made, *FLEET.ids)
    agent(made, 4, 300, "running", VERSION + 1)
    plant(made, 4, 300, driving=True)
    assert made.message.version == VERSION
    assert not made.done
    assert made.outcome(4) == (
        "robot 4: running: another operator has let it drive again, its plant does not brake"
    )


def test_it_brakes_since_it_said_so_not_since_its_disk_has_the_stop() -> None:
    made = stopping("a person")
    brake(made, *FLEET.ids[1:])
    plant(made, 1, 10, driving=False)
    agent(made, 1, 20, "stopping", 0, "stop: somebody else")
    assert "not taken" in made.outcome(1)
    agent(made, 1, 30, "stopping", 0, "stop: a person")
    assert not made.done
    assert made.outcome(1) == (
        "robot 1: stopping after 30 ms, and has not kept the stop yet: started again, it would not know of "
        "it, its plant brakes after 10 ms"
    )
    agent(made, 1, 900, "stopped", reason="stop: a person")
    assert made.done
    assert made.outcome(1).startswith("robot 1: stopped after 30 ms, ")


def test_of_many_those_that_brake_are_one_line_and_the_others_one_each() -> None:
    made = stopping()
    brake(made, *FLEET.ids[:-2])
    made.found(EPOCH + 840 * MS, 7, "agent", "stopped", VERSION, "over ssh to host7")
    made.found(EPOCH + 700 * MS, 7, "plant", "braking", VERSION, "over ssh to host7")
    agent(made, 8, 25, "running", 0)
    assert made.outcomes(each=False) == [
        "5 of 6 robots brake, the last after 840 ms (4 over a new link, 1 over ssh)",
        "robot 8: running: its agent has not taken the stop, nothing heard from its plant",
    ]
    assert made.outcomes(each=True) == [made.outcome(robot) for robot in FLEET.ids]
    assert stopping().outcomes(each=False) == [
        "0 of 6 robots brake",
        "robots 1, 2, 3, 4, 7 and 8: nothing heard from its agent, nothing heard from its plant",
    ]


def test_of_those_that_brake_by_other_ways_alone_it_says_that_they_did_not_acknowledge_it_here() -> None:
    made = Stopping(replace(FLEET, robots=[replace(FLEET.robots[0], id=k) for k in range(1, 101)]), EPOCH, "")
    unheard = range(1, 21)
    for robot in unheard:
        made.found(EPOCH + 700 * MS, robot, "agent", "stopped", made.message.version, "over ssh to host7")
        made.found(EPOCH + 840 * MS, robot, "plant", "braking", made.message.version, "over ssh to host7")
    assert made.outcomes_elsewhere(unheard) == [
        "not acknowledged here by 20 of 100 robots: 20 of 20 robots brake, the last after 840 ms "
        "(20 over ssh)"
    ]
    assert made.outcomes_elsewhere((1, 7)) == [made.outcome(1), made.outcome(7)]
    assert made.outcomes_elsewhere(()) == []


def test_of_a_clock_that_is_days_ahead_it_takes_the_robots_time() -> None:
    made = Stopping(FLEET, EPOCH + 3 * 86_400 * S, "")
    began = made.message.version
    status = Status(1, 1, EPOCH, "running", "", "", 1, 0, (), (), (), ())
    made.feed(EPOCH + 3 * 86_400 * S, key_expressions.status("square", 1), status)
    given = VERSION
    assert made.message.version == given < began, "robots acknowledge what can be"
    # One that takes the first only now, as of its own time, is outdone, so that all acknowledge the same.
    agent(made, 2, 10, "stopping", given + 7)
    assert made.message.version == given + 8
    brake(made, *FLEET.ids)
    assert made.done
    assert made.outcomes(each=True)[-1].startswith(
        "set this machine's clock: it is 72 h ahead of the robots'"
    )
    assert made.outcomes(each=False)[-1] == made.outcomes(each=True)[-1]


def test_one_robot_whose_clock_is_behind_takes_no_stop_away() -> None:
    made = stopping()
    status = Status(1, 1, 0, "running", "", "", 1, 0, (), (), (), ())
    for _ in range(3):
        made.feed(EPOCH + MS, key_expressions.status("square", 1), status)
    agent(made, 2, 10, "running", VERSION - 5)
    assert made.message.version == VERSION, "another believes this machine's clock"
    agent(made, 3, 10, "running", VERSION + 5)
    assert made.message.version == VERSION + 6, "later than all that others have"
    brake(made, *FLEET.ids)
    assert made.done
    assert "clock" not in made.outcomes(each=True)[-1], "it is not this machine's that is wrong"


def test_a_robot_whose_clock_is_days_behind_brakes_by_a_stop_of_its_own_time() -> None:
    """It takes the stop as one that is given when it hears it, and cannot acknowledge its version."""
    made = stopping("lunch")
    days_ago = EPOCH - 3 * 86_400 * S

    def late(state: str, after_ms: int, reason: str) -> None:
        known = days_ago // 1_000 - 1
        status = Status(1, 1, days_ago + after_ms * MS, state, "", reason, 1, known, (), (), (), ())
        made.feed(EPOCH + after_ms * MS, key_expressions.status("square", 1), status)

    late("running", 5, "")
    agent(made, 2, 10, "stopping", VERSION - 5)  # believes this machine's clock
    brake(made, *FLEET.ids[1:])
    plant(made, 1, 20, driving=False)
    late("stopped", 25, "stop: the run is over")
    assert not made.done, "by an older stop"
    late("stopping", 30, "stop: lunch")
    assert made.done, made.outcome(1)
    assert made.outcome(1).startswith("robot 1: stopping after 30 ms")


def test_who_makes_up_later_orders_again_and_again_takes_no_stop_away() -> None:
    made = stopping()
    day = 20 * 3600 * 1_000_000
    for k in range(20):
        agent(made, 1, 10 + k, "running", VERSION + day + 1000 * k)
        brake(made, *FLEET.ids[1:])  # they acknowledge what they were sent
    assert [made.stands_by(robot) for robot in FLEET.ids] == [False, *[True] * (len(FLEET.ids) - 1)]
    assert "not taken" in made.outcome(1)


def test_of_a_clock_that_is_days_behind_it_is_later_than_what_robots_have_and_says_so() -> None:
    days_ago = EPOCH - 3 * 86_400 * S
    made = Stopping(FLEET, days_ago, "")
    status = Status(1, 1, EPOCH, "running", "", "", 1, VERSION - 7, (), (), (), ())
    made.feed(days_ago + MS, key_expressions.status("square", 1), status)
    assert made.message.version == VERSION - 6
    for robot in FLEET.ids:
        said = status._replace(robot=robot, state="stopping", order_version=VERSION - 6)
        made.feed(days_ago + MS, key_expressions.status("square", robot), said)
        plant(made, robot, 30, driving=False)
    assert made.done
    last = "set this machine's clock: it is 72 h behind the robots'"
    assert made.outcomes(each=True)[-1] == made.outcomes(each=False)[-1] == last


def test_who_is_down_finds_it_later_and_is_waited_for_no_longer() -> None:
    made, way = stopping(), "over ssh to host1"
    for robot in FLEET.ids:
        for role in ROLES:
            made.found_down(robot, role, VERSION - 9, -1, way)
    assert not made.settled, "it does not lie there"
    for robot in FLEET.ids:
        for role in ROLES:
            made.found_down(robot, role, VERSION - 9, VERSION, way)
    assert (made.settled, made.heard, made.done) == (True, True, False)
    assert made.outcome(1) == "robot 1: is down; it finds the stop when it comes up (over ssh to host1)"
    # One that has kept a later order would not follow it: another one is to be laid for all.
    made.found_down(2, "plant", VERSION + 4, VERSION, way)
    assert made.message.version == VERSION + 5
    assert not made.settled
    for robot in FLEET.ids:
        for role in ROLES:
            made.found_down(robot, role, VERSION + 4, VERSION + 5, way)
    assert made.settled
    agent(made, 3, 40, "running", 0)
    assert not made.settled, "it is up"


def test_two_who_stop_a_fleet_at_once_do_not_outdo_each_other_for_ever() -> None:
    """All robots have the last stop of either all the time, and brake by it."""
    two = stopping("one"), Stopping(FLEET, EPOCH + MS, "two")
    sent: list[int] = []
    for k in range(40):
        version, reason = max((each.message.version, each.message.reason) for each in two)
        sent.append(version)
        for made in two:
            agent(made, 1 + k % 8, 20 + k, "stopping", version, f"stop: {reason}")
            plant(made, 1 + k % 8, 20 + k, driving=False)
    assert len(set(sent)) <= 2 * STOPS_OUTDONE_MAX + 2
    for made in two:
        for robot in FLEET.ids:
            agent(made, robot, 100, "stopped", sent[-1], "stop: two")
        assert made.done, made.outcomes(each=True)
        # A later leave is none of those: it is outdone as ever.
    agent(two[0], 3, 200, "running", sent[-1] + 5)
    assert not two[0].done
