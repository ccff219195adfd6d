"""The table of transitions as a whole: every state and every combination of conditions."""

from __future__ import annotations

from itertools import product

import pytest

from agent.supervision import TRANSITIONS, Conditions, State, step

WELL = Conditions(plant="", numbers="", neighbours="", mission="", stop="", started=True, at_rest=False)
TROUBLE = Conditions("no plant", "NaN", "silent 2", "no mission", "stopped", started=True, at_rest=True)
EVERY = [
    Conditions._make((TROUBLE[k] if told else "") if k < 5 else told for k, told in enumerate(bits))
    for bits in product((False, True), repeat=7)
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
        "waiting", "ready", "running", "holding", "stopping", "stopped", "fault"
    }  # fmt: skip


# ---------------------------------------------------------------------- invariants over everything


@pytest.mark.parametrize("state", State)
def test_drives_only_when_all_is_well(state: State):
    for conditions in EVERY:
        if step(state, conditions)[0] is State.RUNNING:
            assert not conditions.numbers
            assert not conditions.plant
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
    for state in (State.RUNNING, State.HOLDING, State.STOPPING):
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


def test_the_way_to_running():
    begin = Conditions("for its plant", "", "silent neighbours: 2", "for a mission", "", False, False)
    state = State.WAITING
    for change, expected, reason in [
        ({}, State.WAITING, "for its plant"),
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
