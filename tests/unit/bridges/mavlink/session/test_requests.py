"""Commands that are sent until they are acknowledged, and parameters that are read by name."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.session.requests import (
    AUDITED,
    COMMAND_TIMEOUT_NS,
    COMMAND_TRIES,
    Commands,
    Outcome,
    Parameters,
    further,
)

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


MS = NS_PER_S // 1000
NAMES = ("A", "B", "C", "D", "E", "F")


def test_at_most_four_are_waited_for_and_one_sent_in_a_tenth_of_a_second() -> None:
    parameters = Parameters(NAMES)
    asked = [parameters.ask(now_ms * MS) for now_ms in range(0, 1000, 50)]
    assert [name for name in asked if name] == ["A", "B", "C", "D"]
    assert asked[:3] == ["A", None, "B"]
    parameters.received("B", 2.0)
    assert parameters.ask(1000 * MS) == "E"


def test_one_that_never_answers_is_missing_after_six_tries() -> None:
    parameters = Parameters(("A",))
    sent = [t for t in range(0, 10_000, 50) if parameters.ask(t * MS)]
    assert sent == [0, 1500, 3000, 4500, 6000, 7500]
    assert parameters.values == {"A": None}
    assert parameters.done


def test_firmware_may_say_that_it_has_none() -> None:
    parameters = Parameters(("A", "B"))
    parameters.missing("A")
    parameters.missing("X")
    assert parameters.values == {"A": None}
    assert not parameters.done
    assert parameters.ask(0) == "B"


def test_a_change_by_somebody_else_is_taken_and_others_are_ignored() -> None:
    parameters = Parameters(("A",))
    assert parameters.received("A", 1.0)
    assert parameters.done
    assert parameters.received("A", 2.0)
    assert parameters.received("X", 3.0)
    assert parameters.values == {"A": 2.0}


def test_a_value_that_is_not_finite_is_refused_and_asked_for_again() -> None:
    parameters = Parameters(("A",))
    assert parameters.ask(0) == "A"
    assert not parameters.received("A", float("nan"))
    assert parameters.values == {}
    assert parameters.ask(2 * NS_PER_S) == "A"


def test_the_name_that_answers_counts() -> None:
    parameters = Parameters(AUDITED)
    parameters.received("SYSID_MYGCS", 3.0)
    assert parameters.first(constants.GROUND_STATION_ID) == 3.0
    assert parameters.values == {"SYSID_MYGCS": 3.0, "MAV_GCS_SYSID": None}
    parameters.received("MAV_GCS_SYSID", 4.0)
    parameters.received("SYSID_MYGCS", 3.0)
    assert parameters.first(constants.GROUND_STATION_ID) == 4.0, "it is said, if both are told"
    assert parameters.first(constants.ARMING_CHECK) is None
    assert parameters.first("SYSID_MYGCS") == 3.0


def test_newer_names_are_given_up_with_the_older_ones_and_the_other_way_round() -> None:
    parameters = Parameters(AUDITED)
    parameters.received("MAV_GCS_SYSID", 1.0)
    assert parameters.values == {"MAV_GCS_SYSID": 1.0, "SYSID_MYGCS": None}
    parameters.received("ARMING_CHECK", 1.0)
    assert parameters.values["ARMING_SKIPCHK"] is None


def test_further_ones_are_read_by_what_the_first_say() -> None:
    parameters = Parameters(("A", "B"), lambda values: ("C",) if values.get("A") == 1.0 else ())
    parameters.received("B", 0.0)
    parameters.received("A", 0.0)
    assert parameters.done
    parameters.received("A", 1.0)  # changed by somebody else
    assert not parameters.done
    assert parameters.ask(0) == "C"
    parameters.received("C", 5.0)
    assert parameters.done
    assert parameters.values["C"] == 5.0
    parameters.restart()
    assert [parameters.ask(k * 100 * MS) for k in range(3)] == ["A", "B", None], "not before A says so"


def test_what_a_fence_and_odd_outputs_cost_is_read_where_they_are() -> None:
    assert further({"FENCE_ENABLE": 0.0, "SERVO1_FUNCTION": 73.0, "SERVO3_FUNCTION": 74.0}) == ()
    assert further({"FENCE_ENABLE": 1.0}) == ("AVOID_ENABLE",)
    assert further({"FENCE_ENABLE": 1.0, "AVOID_ENABLE": None}) == ()
    assert further({"SERVO1_FUNCTION": 26.0, "SERVO3_FUNCTION": 70.0}) == ("FRAME_TYPE",)


def test_a_restart_reads_everything_anew() -> None:
    parameters = Parameters(("A",))
    parameters.ask(0)
    parameters.received("A", 1.0)
    parameters.restart()
    assert parameters.values == {}
    assert parameters.ask(0) == "A"
