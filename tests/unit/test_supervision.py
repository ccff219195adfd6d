"""The table of transitions as a whole: every state and every combination of conditions."""

from __future__ import annotations

from itertools import product

import pytest

from agent.supervision import TRANSITIONS, Conditions, State, step

WELL = Conditions(
    plant="", body="", numbers="", neighbours="", mission="", stop="", started=True, at_rest=False
)
TROUBLE = Conditions("no plant", "MANUAL", "NaN", "silent 2", "no mission", "stopped", True, True)
TEXTS = sum(isinstance(value, str) for value in WELL)
EVERY = [
    Conditions._make((TROUBLE[k] if told else "") if k < TEXTS else told for k, told in enumerate(bits))
    for bits in product((False, True), repeat=len(WELL))
]
CASES = list(product(State, EVERY))
STANDING = frozenset({State.WAITING, State.READY, State.STOPPED})
BRAKING = frozenset(State) - {State.RUNNING}


def settled(state: State, conditions: Conditions) -> State:
    """Where the table leads when the conditions stay."""
    for _ in range(10):
        after, _ = step(state, conditions)
        if after is state:
            return state
        state = after
    raise AssertionError(f"the table goes round in circles under {conditions}")


# ---------------------------------------------------------------------- the table as a table


def test_names_are_unique_and_every_row_has_its_sources():
    names = [row.name for row in TRANSITIONS]
    assert len(set(names)) == len(names)
    assert all(row.sources for row in TRANSITIONS)


def test_every_row_is_used():
    used = {row.name for state, c in CASES if (row := step(state, c)[1]) is not None}
    assert used == {row.name for row in TRANSITIONS}


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


def test_values_are_what_status_messages_carry():
    assert {state.value for state in State} == {
        "waiting", "ready", "running", "holding", "released", "stopping", "stopped", "fault"
    }  # fmt: skip


# ---------------------------------------------------------------------- invariants over everything


@pytest.mark.parametrize("state", State)
def test_drives_only_when_all_is_well(state: State):
    for conditions in EVERY:
        if step(state, conditions)[0] is State.RUNNING:
            assert not conditions.numbers
            assert not conditions.plant
            assert not conditions.body
            assert not conditions.neighbours
            assert not conditions.stop


@pytest.mark.parametrize("state", State)
def test_drives_only_from_the_epoch_on(state: State):
    """Also a robot that drives when a new mission with a later epoch comes: what its neighbours do
    until then is to stand, and so they are predicted."""
    for conditions in EVERY:
        if not conditions.started:
            assert step(state, conditions)[0] is not State.RUNNING, conditions


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
    for state in (State.RUNNING, State.HOLDING, State.RELEASED, State.STOPPING):
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


def test_a_stopped_robot_moves_only_after_a_new_mission():
    for conditions in EVERY:
        after, _ = step(State.STOPPED, conditions)
        if conditions.numbers:
            assert after is State.FAULT
        else:
            assert after is (State.STOPPED if conditions.stop else State.WAITING)


def test_a_silent_neighbour_holds_a_running_robot_and_lets_it_go_on():
    silent = WELL._replace(neighbours="silent neighbours: 2")
    after, row = step(State.RUNNING, silent)
    assert (after, row.reason(silent)) == (State.HOLDING, "silent neighbours: 2")
    assert step(State.HOLDING, silent)[0] is State.HOLDING
    after, row = step(State.HOLDING, WELL)
    assert (after, row.name) == (State.RUNNING, "neighbour_back")


RELEASED = WELL._replace(body="mode MANUAL")


@pytest.mark.parametrize("state", [State.RUNNING, State.HOLDING, State.RELEASED])
def test_a_body_that_its_operator_takes_is_released_and_comes_back(state: State):
    after, row = step(state, RELEASED)
    assert (after, row.name, row.reason(RELEASED)) == (State.RELEASED, "body_released", "mode MANUAL")
    disarmed = WELL._replace(body="disarmed")
    after, row = step(State.RELEASED, disarmed)
    assert (after, row.reason(disarmed)) == (State.RELEASED, "disarmed")  # the reason is the newest
    after, row = step(State.RELEASED, WELL)
    assert (after, row.name) == (State.RUNNING, "body_back")


def test_a_body_that_is_given_back_waits_for_its_neighbours():
    silent = WELL._replace(neighbours="silent neighbours: 2")
    assert step(State.RELEASED, silent)[0] is State.HOLDING
    assert step(State.RELEASED, silent._replace(body="mode MANUAL"))[0] is State.RELEASED


def test_a_body_that_was_never_handed_over_is_waited_for():
    """Also in mid-mission: an agent that starts again then does not know that there was a drive."""
    for started, mission in product((False, True), ("", "for a mission")):
        conditions = RELEASED._replace(started=started, mission=mission)
        for state in (State.WAITING, State.READY):
            after, row = step(state, conditions)
            assert (after, row.reason(conditions)) == (State.WAITING, "mode MANUAL")
    assert step(State.WAITING, WELL)[0] is State.RUNNING


def test_of_a_released_robot_more_than_its_body_may_be_wrong():
    """The first of these rows wins: numbers, plant, stop, another epoch, body."""
    stop = RELEASED._replace(stop="stop: lunch", started=False)
    for conditions, expected in [
        (stop._replace(numbers="NaN", plant="no plant"), State.FAULT),
        (stop._replace(plant="no plant"), State.FAULT),
        (stop, State.STOPPING),
        (stop._replace(stop=""), State.READY),
        (RELEASED._replace(neighbours="silent 2"), State.RELEASED),
    ]:
        assert step(State.RELEASED, conditions)[0] is expected, conditions


def test_a_stop_while_released_lasts_although_the_operator_drives_on():
    stop = RELEASED._replace(stop="stop: lunch")
    assert settled(State.RELEASED, stop) is State.STOPPING
    assert settled(State.STOPPING, stop._replace(at_rest=True)) is State.STOPPED
    assert step(State.STOPPED, WELL._replace(stop="stop: lunch"))[0] is State.STOPPED
    new_mission = RELEASED
    assert settled(State.STOPPED, new_mission) is State.WAITING
    assert settled(State.STOPPED, WELL) is State.RUNNING


def test_a_body_that_is_lost_while_released_is_released_again_when_it_is_back():
    assert step(State.RELEASED, RELEASED._replace(plant="plant silent"))[0] is State.FAULT
    assert settled(State.FAULT, RELEASED) is State.WAITING
    assert settled(State.FAULT, WELL) is State.RUNNING


def test_the_way_to_running():
    begin = Conditions("for its plant", "", "", "silent neighbours: 2", "for a mission", "", False, False)
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


def test_every_braking_state_says_why():
    """But for STOPPED, which keeps the reason of the stop, and for what lasts one tick."""
    for state, conditions in CASES:
        if conditions.started and not conditions.mission:
            conditions = conditions._replace(at_rest=False)
        after, row = step(state, conditions)
        if row is None or row.name in ("plant_back", "restart"):
            continue
        if after in BRAKING:
            assert row.reason(conditions), (state, conditions, row.name)


def test_nothing_goes_round_in_circles():
    for state, conditions in CASES:
        settled(state, conditions)
