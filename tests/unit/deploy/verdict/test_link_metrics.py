"""What metrics say of links, against messages whose numbers are known by hand."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
    DUPLICATED,
    LOST,
    OVERFLOW,
    RANGE,
    REORDERED,
    Decision,
    Faults,
    LinkTrace,
    Status,
)
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict import link_metrics
from handfast.deploy.verdict.link_metrics import ages, clock_offsets, clock_warnings, describe_links
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.simulated_run import driven, recorded, trio
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, in_formation, make_fleet, messages, triangle

TRIANGLE = make_fleet(*triangle(2))
NAME = TRIANGLE.fleet.name


def at(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def fed(*extra: Sent, statuses: bool = True) -> Recording:
    """A run of three robots in formation, 2 s long, with further messages."""
    data = RunData(TRIANGLE)
    for each in messages(TRIANGLE, in_formation(TRIANGLE)):
        if statuses or type(each[2]) is not Status:
            data.feed(*each)
    for each in extra:
        data.feed(*each)
    return data.recording()


def idle_rules(recording: Recording) -> list[str]:
    return link_metrics.idle_rules(recording, analyse(recording, resolve(recording.fleet)))


def trace(robot: int, *entries: tuple[int, int, int, int, int, int]) -> Sent:
    return (
        at(1.9),
        key_expressions.links(NAME, robot),
        LinkTrace(robot, 0, at(1.9), tuple(map(Decision._make, entries))),
    )


def status(robot: int, t: float, *neighbours: tuple[int, ...], ages_us: tuple[int, ...] = ()) -> Sent:
    rows: Any = neighbours
    message = Status(robot, 0, at(t), "running", "epoch", "", 1, 0, rows, (), ages_us, ())
    return at(t), key_expressions.status(NAME, robot), message


# --- what was done ----------------------------------------------------------------------------


def test_what_was_done_is_counted_by_message_and_by_copy() -> None:
    t = at(0.5)
    recording = fed(
        trace(
            2,
            (1, 0, 1, t + 1, 0, 100),
            (1, 0, 2, t + 2, LOST, -1),
            (1, 0, 3, t + 3, LOST | RANGE, -1),
            (1, 0, 4, t + 4, LOST | OVERFLOW, -1),  # the first copy, and the second came
            (1, 0, 4, t + 4, DUPLICATED, 300),
            (1, 0, 5, t + 5, REORDERED, 0),
            (1, 0, 6, t + 6, 0, 600),
            (1, 0, 7, t + 7, 0, 250),
            (1, 0, 7, t + 7, DUPLICATED, 250),
            (3, 0, 6, t + 6, 0, 5_000),
        )
    )
    found = describe_links(recording)
    first, second = found["links"]
    assert (first["link"], first["topic"], first["decided"]) == ("1->2", "hand", 7)
    assert first["injected"] == {
        "lost": 2, "rate": pytest.approx(2 / 7, abs=1e-6), "duplicated": 2, "corrupted": 0, "reordered": 1,
        "overflow": 1, "range": 1,
        "delay_ms": {"mean": 0.25, "p50": 0.25, "p95": pytest.approx(0.525), "max": 0.6},
    }  # fmt: skip
    assert (second["link"], second["decided"], second["injected"]["delay_ms"]["max"]) == ("3->2", 1, 5.0)
    assert found["injected"]["decided"] == 8
    assert found["injected"]["lost"] == 2


def test_what_was_asked_is_said_rule_by_rule() -> None:
    fleet = trio(
        '[faults]\ndelay = "10ms"\n'
        '[[faults.rule]]\nname = "cut"\nlink = "1<->2"\nloss = "100%"\nat = 1\nfor = 0.5\n'
        '[[faults.rule]]\nrobot = 1\ntopic = "all"\nduplicate = "1%"\n'
    )
    found = {
        (one["link"], one["topic"]): one["asked"]
        for one in describe_links(recorded(fleet, driven(fleet)))["links"]
    }
    assert (
        found["2->1", "hand"]
        == "loss 100% (cut, from 1 to 1.5 s); duplicate 1% (rule 2, all the time); delay 10ms"
    )
    assert found["3->2", "hand"] == "delay 10ms"
    assert found["1->1", "state"] == "duplicate 1% (rule 2, all the time)"


# --- what receivers measured ------------------------------------------------------------------


def test_messages_of_the_drive_are_counted_between_two_statuses() -> None:
    recording = fed(
        trace(2, (1, 0, 1, at(0.5), 0, 0)),
        status(2, -0.05, (1, 0, 100, 7, 0, -1), (3, 0, 1, 1, 0, -1)),
        status(2, 1.0, (1, 0, 140, 9, 0, -1), (3, 0, 2, 2, 0, -1)),
        status(2, 1.5, (1, 0, 5, 1, 0, -1), (3, 0, 3, 3, 0, -1)),  # it was started again
        status(2, 1.9, (1, 0, 20, 3, 0, -1), (3, 0, 4, 4, 0, -1)),
        status(2, 2.6, (1, 0, 90, 50, 0, -1), (3, 0, 5, 5, 0, -1)),  # after the end
        statuses=False,
    )
    (link,) = describe_links(recording)["links"]
    # One message every 20 ms, from -0.05 s to 1.9 s: the first at -0.04 s.
    assert link["measured"] == {"sent": 98, "received": 40 + 5 + 15, "lost": 2 + 1 + 2}


def test_what_came_before_the_first_status_is_not_counted() -> None:
    recording = fed(
        trace(2, (1, 0, 1, at(0.5), 0, 0)),
        status(2, 0.5, (1, 0, 100, 7, 0, -1), (3, 0, 1, 1, 0, -1)),  # its agent came late: of which 100?
        status(2, 1.5, (1, 0, 149, 8, 0, -1), (3, 0, 2, 2, 0, -1)),
        statuses=False,
    )
    (link,) = describe_links(recording)["links"]
    assert link["measured"] == {"sent": 50, "received": 49, "lost": 1}


def test_of_own_plants_only_what_was_sent_is_known() -> None:
    recording = fed(
        (
            at(1.9),
            key_expressions.plant_links(NAME, 1),
            LinkTrace(1, 0, at(1.9), (Decision(1, 2, 1, at(0.5), 0, 0),)),
        )
    )
    (link,) = describe_links(recording)["links"]
    assert (link["link"], link["topic"]) == ("1->1", "wrench")
    assert link["measured"] == {"sent": 100, "received": None, "lost": None}
    assert link["age_ms"] is None


def test_ages_are_told_link_by_link_and_tick_by_tick() -> None:
    two = ((1, 5_000, 0, 0, 0, -1), (3, 50_000, 0, 0, 0, -1))
    recording = fed(
        status(2, 0.1, *two, ages_us=(9, 9)),  # the first: who had been heard before is not known
        status(2, 0.2, *two, ages_us=(1_000, 10_000, 2_000, 20_000, 3_000, 30_000)),
        status(2, 0.3, (1, -1, 0, 0, 0, -1), two[1], ages_us=(7, 7)),  # started again: only 3 was heard
        status(2, 0.4, *two, ages_us=(7, 7)),
        status(2, 0.5, *two, ages_us=(4_000, 40_000)),
        statuses=False,
    )
    found = ages(recording)
    t, values = found[1, 2]
    assert t.tolist() == pytest.approx([0.16, 0.18, 0.2, 0.5])
    assert values.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert found[3, 2][1].tolist() == [10.0, 20.0, 30.0, 40.0]


def test_ages_of_a_status_with_other_neighbours_do_not_mix() -> None:
    one, other = (1, 5_000, 0, 0, 0, -1), (3, 50_000, 0, 0, 0, -1)
    recording = fed(
        status(2, 0.1, one, other, ages_us=(9, 9)),
        status(2, 0.2, one, other, ages_us=(1_000, 10_000)),
        status(2, 0.3, other, ages_us=(20_000,)),  # of an agent with another fleet file
        statuses=False,
    )
    found = {link: values.tolist() for link, (_, values) in ages(recording).items()}
    assert found == {(1, 2): [1.0], (3, 2): [10.0, 20.0]}


# --- clocks -----------------------------------------------------------------------------------


def clocks(**seen: tuple[int, int]) -> Recording:
    """Statuses at 1.9 s; ``r1n2=(offset, error)`` us: what robot 1 thinks of the clock of 2."""
    by_robot: dict[int, list[tuple[int, ...]]] = {1: [], 2: [], 3: []}
    for name, (offset, error) in seen.items():
        by_robot[int(name[1])].append((int(name[3]), 0, 0, 0, offset, error))
    sent = [status(robot, 1.9, *entries) for robot, entries in by_robot.items()]
    return fed(*sent, statuses=False)


def test_a_clock_that_is_off_is_named_once() -> None:
    recording = clocks(
        r1n3=(120_000, 10_000), r3n1=(-121_000, 10_000), r2n3=(118_000, 9_000), r3n2=(-118_000, 9_000),
        r1n2=(1_000, 9_000), r2n1=(-1_000, 9_000),
    )  # fmt: skip
    (warning,) = clock_warnings(recording, clock_offsets(recording))
    assert warning == (
        "Robot 3's clock is 0.119 s ahead of those of robots 1 and 2, within 0.010 s, as their messages "
        "tell; 0.05 s is allowed."
    )
    found = RunResult(recording).metrics
    assert warning in found["verdict"]["warnings"]
    assert len(found["clock_offsets"]) == 6
    assert {"robot": 1, "neighbour": 3, "offset_ms": 120.0, "error_ms": 10.0} in found["clock_offsets"]


def test_of_two_robots_nobody_knows_whose_clock_is_off() -> None:
    recording = clocks(r1n2=(-90_000, 5_000))
    (warning,) = clock_warnings(recording, clock_offsets(recording))
    assert warning.startswith("Robot 1's clock is 0.090 s ahead of that of robot 2, within 0.005 s")
    assert warning.endswith("It may be the other one's that is wrong.")


def test_what_one_end_says_of_clocks_and_the_other_denies_accuses_nobody() -> None:
    recording = clocks(r2n1=(900_000, 1_000), r1n2=(100, 1_000))
    assert clock_warnings(recording, clock_offsets(recording)) == []
    both = clocks(r2n1=(900_000, 1_000), r1n2=(-900_000, 1_000))
    assert len(clock_warnings(both, clock_offsets(both))) == 1


@pytest.mark.parametrize("seen", [(40_000, 1_000), (500_000, 460_000), (999_000, -1)])
def test_a_clock_that_is_not_proven_to_be_off_is_not_warned_of(seen: tuple[int, int]) -> None:
    recording = clocks(r1n2=seen)
    assert clock_warnings(recording, clock_offsets(recording)) == []


# --- rules that did nothing -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "says"),
    [
        ('[[faults.rule]]\nname = "x"\nlink = "1->2"\nloss = "9%"\nat = 5\n',
         "Rule 'x' never held: it begins at 5.0 s, and the drive ended at 1.0 s."),
        ('[[faults.rule]]\nname = "x"\nlink = "1->2"\ntopic = "state"\nloss = "9%"\n',
         "Rule 'x' (loss 9% on state, 1->2) is for no link of this fleet: no message goes there."),
        ('[[faults.rule]]\nname = "x"\nrobot = 2\npause = "agent"\nat = 5\nfor = 1\n',
         "Rule 'x' (pause agent of robot 2, from 5 to 6 s) did nothing."),
    ],
)  # fmt: skip
def test_a_rule_that_did_nothing_is_named(faults: str, says: str) -> None:
    fleet = trio(faults, duration=1.0)
    recording = recorded(fleet, driven(fleet))
    assert idle_rules(recording) == [says]
    found = RunResult(recording).metrics
    assert says in found["verdict"]["warnings"]


def test_a_rule_whose_messages_nobody_decided_on_is_named() -> None:
    fleet = trio(
        '[faults]\nloss = "9%"\n[[faults.rule]]\nname = "x"\nlink = "1->2"\nloss = "8%"\nat = 0.5\n', 1.0
    )
    sent = [each for each in driven(fleet) if not isinstance(each[2], LinkTrace)]
    assert idle_rules(recorded(fleet, sent)) == [
        "What [faults] gives every link (loss 9%) met no message.",
        "Rule 'x' (loss 8% on 1->2, from 0.5 s on) met no message.",
    ]


def test_a_live_rule_that_did_nothing_is_named() -> None:
    fleet = trio(duration=1.0)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        rules = '[[faults.rule]]\nlink = "1->2"\nloss = "9%"\nat = 3\n'
        return [(0.25, Faults(1, epoch_ns, "ana@lab", epoch_ns + 500_000_000, 0, rules))]

    (told,) = idle_rules(recorded(fleet, driven(fleet, live)))
    assert (
        told == "Rule 'live rule 1' of ana@lab never held: it begins at 3.5 s, and the drive ended at 1.0 s."
    )


def test_a_live_rule_that_was_cleared_before_it_began_is_named() -> None:
    fleet = trio(duration=1.5)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        rules = '[[faults.rule]]\nlink = "1->2"\nloss = "9%"\nat = 3\n'
        return [
            (0.25, Faults(1, epoch_ns, "ana@lab", epoch_ns, 0, rules)),
            (0.5, Faults(2, epoch_ns + 500_000_000, "ana@lab", epoch_ns, 0, "")),
        ]

    (told,) = idle_rules(recorded(fleet, driven(fleet, live)))
    assert "begins at 3.0 s, and its set ended at 0." in told


def test_rules_that_worked_are_not_named() -> None:
    fleet = trio(
        '[faults]\ndelay = "20ms"\n'
        '[[faults.rule]]\nlink = "1->2"\nloss = "50%"\nat = 0.2\nfor = 0.1\nevery = 0.2\n'
        '[[faults.rule]]\nrobot = 2\nrestart = "plant"\nat = 0.5\n'
    )
    assert idle_rules(recorded(fleet, driven(fleet))) == []
