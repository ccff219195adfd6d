"""Commands: sent three times, answered once, overtaken, cancelled."""

from __future__ import annotations

import pytest

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.requests import COMMAND_TIMEOUT_NS, COMMAND_TRIES, Commands, Outcome

MODE, ARM = constants.CMD_DO_SET_MODE, constants.CMD_COMPONENT_ARM_DISARM
VALUES = (1.0, 15.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def asked() -> Commands:
    """A request for GUIDED, sent once at time 0."""
    commands = Commands()
    commands.give(MODE, 1, 15)
    assert commands.due(0) == [(MODE, 0, VALUES)]
    return commands


def test_a_command_is_repeated_with_its_count_and_then_given_up() -> None:
    commands = asked()
    for tries in range(1, COMMAND_TRIES):
        assert commands.due(tries * COMMAND_TIMEOUT_NS - 1) == []
        assert commands.due(tries * COMMAND_TIMEOUT_NS) == [(MODE, tries, VALUES)]
    assert commands.outcome(MODE) == Outcome("waiting")
    assert commands.waiting
    assert commands.due(COMMAND_TRIES * COMMAND_TIMEOUT_NS) == []
    assert commands.outcome(MODE) == Outcome("no answer")
    assert not commands.waiting


@pytest.mark.parametrize(
    ("result", "state", "text"),
    [
        (constants.RESULT_ACCEPTED, "accepted", "accepted"),
        (constants.RESULT_DENIED, "refused", "denied"),
        (99, "refused", "refused with result 99"),
    ],
)
def test_an_answer_ends_it(result: int, state: str, text: str) -> None:
    commands = asked()
    commands.answered(1, MODE, result)
    outcome = commands.outcome(MODE)
    assert outcome == Outcome(state, result)
    assert outcome.text == text
    assert commands.due(10 * COMMAND_TIMEOUT_NS) == []


def test_one_in_progress_gets_more_time() -> None:
    commands = asked()
    commands.answered(0, MODE, constants.RESULT_IN_PROGRESS)
    assert commands.outcome(MODE) == Outcome("waiting")
    assert commands.due(5 * COMMAND_TIMEOUT_NS - 1) == []
    assert commands.due(5 * COMMAND_TIMEOUT_NS) == [(MODE, 1, VALUES)]


def test_one_overtaken_by_events_is_not_repeated_but_may_be_answered() -> None:
    commands = asked()
    commands.no_more(MODE)
    assert commands.due(COMMAND_TIMEOUT_NS - 1) == []
    commands.answered(COMMAND_TIMEOUT_NS - 1, MODE, constants.RESULT_ACCEPTED)
    assert commands.outcome(MODE) == Outcome("accepted", constants.RESULT_ACCEPTED)
