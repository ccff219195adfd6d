"""The table of transitions as a whole: every state and every combination of conditions."""

from __future__ import annotations

from itertools import product

import pytest

from handfast.agent.supervision.state_machine import DRIVING, TRANSITIONS, Conditions, State, step

WELL = Conditions(
    plant="", body="", numbers="", place="", neighbours="", mission="", stop="", hold="", degraded="",
    started=True, at_rest=False,
)  # fmt: skip
TROUBLE = Conditions(
    "no plant", "MANUAL", "NaN", "in reserve", "silent 2", "no mission", "stopped", "no heartbeat",
    "without 3", True, True,
)  # fmt: skip
TEXTS = sum(isinstance(value, str) for value in WELL)
EVERY = [
    Conditions._make((TROUBLE[k] if told else "") if k < TEXTS else told for k, told in enumerate(bits))
    for bits in product((False, True), repeat=len(WELL))
]
CASES = list(product(State, EVERY))
STANDING = frozenset({State.WAITING, State.READY, State.STANDBY, State.STOPPED})
BRAKING = frozenset(State) - DRIVING


def settled(state: State, conditions: Conditions) -> State:
    """Where the table leads when the conditions stay."""
    for _ in range(10):
        after, _ = step(state, conditions)
        if after is state:
            return state
        state = after
    raise AssertionError(f"the table goes round in circles under {conditions}")


# ---------------------------------------------------------------------- the table as a table


def test_every_row_can_be_reached_from_each_of_its_sources():
    """A source that an earlier row always takes is a mistake in the table."""
    used = {(row.name, state) for state, c in CASES if (row := step(state, c)[1]) is not None}
    assert used == {(row.name, source) for row in TRANSITIONS for source in row.sources}


def test_every_state_is_reachable_from_the_start():
    reached, fresh = {State.WAITING}, [State.WAITING]
    while fresh:
        state = fresh.pop()
        for conditions in EVERY:
            after, _ = step(state, conditions)
            if after not in reached:
                reached.add(after)
                fresh.append(after)
    assert reached == set(State)


def test_step_takes_the_first_row_that_applies():
    for state, conditions in CASES:
        after, row = step(state, conditions)
        applicable = [r for r in TRANSITIONS if state in r.sources and r.applies(conditions)]
        assert row is (applicable[0] if applicable else None)
        assert after is (row.target if row is not None else state)


# ---------------------------------------------------------------------- invariants over everything


@pytest.mark.parametrize("state", State)
def test_drives_only_when_all_is_well(state: State):
    for conditions in EVERY:
        if step(state, conditions)[0] in DRIVING:
            assert not conditions.numbers
            assert not conditions.plant
            assert not conditions.body
            assert not conditions.place
            assert not conditions.stop
            if state in (State.WAITING, State.READY):
                assert not conditions.neighbours


@pytest.mark.parametrize("state", State)
def test_never_drives_while_it_has_to_hold(state: State):
    """Not for one tick: without an operator's heartbeat a fleet must not move at its epoch."""
    for conditions in EVERY:
        if conditions.hold:
            assert step(state, conditions)[0] not in DRIVING, conditions


@pytest.mark.parametrize("state", State)
def test_a_robot_without_a_place_never_drives_and_stands_by(state: State):
    for conditions in EVERY:
        if conditions.place:
            assert step(state, conditions)[0] not in DRIVING
            if not (conditions.plant or conditions.numbers or conditions.stop):
                assert settled(state, conditions) is State.STANDBY


@pytest.mark.parametrize("state", [State.RUNNING, State.DEGRADED, State.HOLDING])
def test_a_robot_is_degraded_exactly_while_there_is_a_reason(state: State):
    for conditions in EVERY:
        after = step(state, conditions)[0]
        if after in DRIVING:
            assert after is (State.DEGRADED if conditions.degraded else State.RUNNING)


@pytest.mark.parametrize("state", State)
def test_drives_only_from_the_epoch_on(state: State):
    """Also a robot that drives when a new mission with a later epoch comes: what its neighbours do
    until then is to stand, and so they are predicted."""
    for conditions in EVERY:
        if not conditions.started:
            assert step(state, conditions)[0] not in DRIVING, conditions


@pytest.mark.parametrize("state", State)
def test_failed_numbers_are_a_fault_for_good(state: State):
    for conditions in EVERY:
        if conditions.numbers:
            assert step(state, conditions)[0] is State.FAULT
            assert settled(State.FAULT, conditions) is State.FAULT


def test_a_fault_of_the_plant_ends_with_it():
    for conditions in EVERY:
        if not conditions.numbers:
            after, row = step(State.FAULT, conditions)
            assert after is (State.FAULT if conditions.plant else State.WAITING)
            assert row is not None
            assert row.name == ("plant_lost" if conditions.plant else "plant_back")


def test_a_robot_that_moves_without_its_plant_is_in_fault():
    for state in (*DRIVING, State.HOLDING, State.RELEASED, State.STOPPING):
        for conditions in EVERY:
            if conditions.plant:
                assert step(state, conditions)[0] is State.FAULT


def test_stop_wins_over_everything_but_a_fault():
    for state, conditions in CASES:
        if not conditions.stop:
            continue
        after, _ = step(state, conditions)
        if conditions.numbers or (conditions.plant and state not in STANDING):
            expected = {State.FAULT}
        elif state is State.FAULT:
            expected = {State.WAITING}  # and stopping in the next tick
        else:
            expected = {State.STOPPING, State.STOPPED}
        assert after in expected, (state, conditions)
        if not conditions.numbers and not conditions.plant:
            stands = conditions.at_rest or state is State.STOPPED
            assert settled(state, conditions) is (State.STOPPED if stands else State.STOPPING)


def test_a_robot_is_stopped_when_it_stands_and_not_before():
    for state, conditions in CASES:
        after, _ = step(state, conditions)
        if after is State.STOPPED and state is not State.STOPPED:
            assert state is State.STOPPING
            assert conditions.at_rest
            assert conditions.stop


def test_a_stopped_robot_moves_only_when_what_stopped_it_is_over():
    """A stop, by leave to drive again; the end of a mission, by a new one."""
    for conditions in EVERY:
        after, _ = step(State.STOPPED, conditions)
        if conditions.numbers:
            assert after is State.FAULT
        else:
            assert after is (State.STOPPED if conditions.stop else State.WAITING)


def test_a_silent_neighbour_degrades_a_robot_and_the_last_one_holds_it():
    one = WELL._replace(neighbours="silent 2", degraded="without robot 2 (0.5 s)")
    after, row = step(State.RUNNING, one)
    assert (after, row.name, row.reason(one)) == (State.DEGRADED, "degraded", "without robot 2 (0.5 s)")
    none = WELL._replace(neighbours="silent 2, 3", hold="hears none of its neighbours: robot 2 (0.9 s)")
    after, row = step(State.DEGRADED, none)
    assert (after, row.name, row.reason(none)) == (State.HOLDING, "hold", none.hold)
    assert step(State.HOLDING, none)[0] is State.HOLDING
    assert step(State.HOLDING, one)[0] is State.DEGRADED
    after, row = step(State.HOLDING, WELL)
    assert (after, row.name) == (State.RUNNING, "hold_ended")
    after, row = step(State.DEGRADED, WELL)
    assert (after, row.name) == (State.RUNNING, "well_again")


RELEASED = WELL._replace(body="mode MANUAL")


@pytest.mark.parametrize("state", [State.RUNNING, State.DEGRADED, State.HOLDING, State.RELEASED])
def test_a_body_that_its_operator_takes_is_released_and_comes_back(state: State):
    after, row = step(state, RELEASED)
    assert (after, row.name, row.reason(RELEASED)) == (State.RELEASED, "body_released", "mode MANUAL")
    disarmed = WELL._replace(body="disarmed")
    after, row = step(State.RELEASED, disarmed)
    assert (after, row.reason(disarmed)) == (State.RELEASED, "disarmed")  # the reason is the newest
    after, row = step(State.RELEASED, WELL)
    assert (after, row.name) == (State.RUNNING, "body_back")


def test_a_body_that_is_given_back_waits_for_its_neighbours():
    silent = WELL._replace(hold="hears none of its neighbours: robot 2 (0.6 s)")
    assert step(State.RELEASED, silent)[0] is State.HOLDING
    assert step(State.RELEASED, silent._replace(body="mode MANUAL"))[0] is State.RELEASED


def test_a_body_that_was_not_handed_over_before_a_drive_is_waited_for():
    for mission in ("", "for a mission"):
        conditions = RELEASED._replace(started=False, mission=mission)
        for state in (State.WAITING, State.READY):
            after, row = step(state, conditions)
            assert (after, row.reason(conditions)) == (State.WAITING, "mode MANUAL")
    assert step(State.WAITING, WELL)[0] is State.RUNNING


def test_a_body_that_is_not_handed_over_in_a_drive_is_released():
    """Whose agent has just started, too, but not before it has heard who is near."""
    for state in (State.WAITING, State.READY):
        after, row = step(state, RELEASED)
        assert (after, row.reason(RELEASED)) == (State.RELEASED, "mode MANUAL")
        assert step(state, RELEASED._replace(neighbours="hears who is near"))[0] is State.WAITING
        assert step(state, RELEASED._replace(plant="no plant"))[0] is State.WAITING


def test_of_a_released_robot_more_than_its_body_may_be_wrong():
    """The first of these rows wins: numbers, plant, stop, another epoch, body."""
    stop = RELEASED._replace(stop="stop: lunch", started=False)
    for conditions, expected in [
        (stop._replace(numbers="NaN", plant="no plant"), State.FAULT),
        (stop._replace(plant="no plant"), State.FAULT),
        (stop, State.STOPPING),
        (stop._replace(stop=""), State.READY),
        (RELEASED._replace(hold="silent 2", degraded="slower"), State.RELEASED),
        (RELEASED._replace(place="it has left the formation"), State.STANDBY),
    ]:
        assert step(State.RELEASED, conditions)[0] is expected, conditions


def test_a_stop_while_released_lasts_although_the_operator_drives_on():
    stop = RELEASED._replace(stop="stop: lunch")
    assert settled(State.RELEASED, stop) is State.STOPPING
    assert settled(State.STOPPING, stop._replace(at_rest=True)) is State.STOPPED
    assert step(State.STOPPED, WELL._replace(stop="stop: lunch"))[0] is State.STOPPED
    assert settled(State.STOPPED, RELEASED) is State.RELEASED
    assert settled(State.STOPPED, WELL) is State.RUNNING


def test_a_body_that_is_lost_while_released_is_released_again_when_it_is_back():
    assert step(State.RELEASED, RELEASED._replace(plant="plant silent"))[0] is State.FAULT
    assert settled(State.FAULT, RELEASED) is State.RELEASED
    assert settled(State.FAULT, WELL) is State.RUNNING


def test_the_way_to_running():
    begin = WELL._replace(
        plant="for its plant", neighbours="silent neighbours: 2", mission="for a mission", started=False
    )
    state = State.WAITING
    for change, expected, reason in [
        ({}, State.WAITING, "for its plant"),
        ({"plant": "", "body": "disarmed"}, State.WAITING, "disarmed"),
        ({"plant": ""}, State.WAITING, "silent neighbours: 2"),
        ({"plant": "", "neighbours": ""}, State.READY, "for a mission"),
        ({"plant": "", "neighbours": "", "mission": ""}, State.READY, "for the epoch"),
        ({"plant": "", "neighbours": "silent 2", "mission": ""}, State.WAITING, "silent 2"),
        ({"plant": "", "neighbours": "", "mission": "", "started": True}, State.RUNNING, ""),
    ]:  # fmt: skip
        conditions = begin._replace(**change)
        state, row = step(state, conditions)
        assert state is expected
        assert row.reason(conditions) == reason


def test_from_reserve_into_the_formation_and_out_again():
    reserve = WELL._replace(place="in reserve")
    state, row = step(State.WAITING, reserve)
    assert (state, row.name, row.reason(reserve)) == (State.STANDBY, "without_place", "in reserve")
    state, row = step(State.STANDBY, WELL)
    assert (state, row.name) == (State.WAITING, "standby_ended")
    assert settled(State.STANDBY, WELL) is State.RUNNING
    left = WELL._replace(place="it has left the formation")
    for state in (*DRIVING, State.HOLDING, State.READY):
        assert step(state, left)[0] is State.STANDBY
    assert settled(State.STANDBY, WELL._replace(neighbours="silent 3")) is State.WAITING
    assert settled(State.STANDBY, left._replace(stop="stop", at_rest=True)) is State.STOPPED


def test_every_braking_state_says_why():
    """But for STOPPED, which keeps the reason of the stop."""
    for state, conditions in CASES:
        if conditions.started and not conditions.mission:
            conditions = conditions._replace(at_rest=False)
        after, row = step(state, conditions)
        if row is None:
            continue
        if after in BRAKING:
            assert row.reason(conditions), (state, conditions, row.name)


def test_nothing_goes_round_in_circles():
    for state, conditions in CASES:
        settled(state, conditions)
