"""Parameters: few requests at a time, six tries, both names where firmware versions differ."""

from __future__ import annotations

from agent.common.time import NS_PER_S
from bridges.mavlink.ardupilot import constants
from bridges.mavlink.session.parameters import AUDITED, Parameters

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
    parameters.received("SYSID_THISMAV", 3.0)
    assert parameters.first(constants.SYSTEM_ID) == 3.0
    assert parameters.values == {"SYSID_THISMAV": 3.0, "MAV_SYSID": None}
    parameters.received("MAV_SYSID", 4.0)
    parameters.received("SYSID_THISMAV", 3.0)
    assert parameters.first(constants.SYSTEM_ID) == 4.0, "it is said, if both are told"
    assert parameters.first(constants.GROUND_STATION_ID) is None
    assert parameters.first("SYSID_THISMAV") == 3.0


def test_a_restart_reads_everything_anew() -> None:
    parameters = Parameters(("A",))
    parameters.ask(0)
    parameters.received("A", 1.0)
    parameters.restart()
    assert parameters.values == {}
    assert parameters.ask(0) == "A"
