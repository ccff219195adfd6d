"""The link audit: every decision on a message in a recording follows from its rules and its seed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.messages.types import EVERY_AUTHOR, LOST, TOPICS, Faults
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.faults.rules import live_sets, spans
from handfast.deploy.recording.recording import LiveFaults, Recording
from tests.simulation.link_audit import AuditResult
from tests.simulation.link_audit import audit as audit_of
from tests.unit.deploy.simulated_run import Sent, driven, recorded, trio

ALL = """
[faults]
delay = "normal 40ms 20ms 20%"
loss = "20% 30%"
[[faults.rule]]
robot = 3
topic = "all"
loss = "gemodel 5% 30%"
duplicate = "10%"
corrupt = "5%"
reorder = "20%"
at = 1
[[faults.rule]]
topic = "state"
robot = 1
delay = "20ms 20ms"
[[faults.rule]]
topic = "wrench"
robot = 2
delay = "0ms..60ms"
at = 0
for = 2
"""
LOSSY = '[faults]\nloss = "30%"\n'
SECOND = 1_000_000_000
HAND = TOPICS.index("hand")


def audit(recording: Recording) -> AuditResult:
    return audit_of(recording, analyse(recording, resolve(recording.fleet)))


@pytest.fixture(scope="module")
def lossy() -> list[Sent]:
    return driven(trio(LOSSY))


def test_every_decision_of_a_run_is_made_again() -> None:
    fleet = trio(ALL)
    result = audit(recorded(fleet, driven(fleet)))
    assert result.agreeing + result.unchecked == result.decided > 900
    assert (result.differing, result.unrecorded, result.unheard) == (0, 0, 0)
    assert result.unchecked == 0


def test_a_run_without_faults_has_nothing_to_prove() -> None:
    fleet = trio(duration=0.5)
    result = audit(recorded(fleet, driven(fleet)))
    assert (result.decided, result.unheard) == (0, 0)


def test_what_depends_on_more_than_the_recording_is_said_not_to_be_checked() -> None:
    fleet = trio(
        '[[faults.rule]]\nlink = "1->2"\nrate = "20kbit"\nat = 0.5\n'
        '[[faults.rule]]\nlink = "2->3"\nrange = "logdistance 1m"\n'
    )
    recording = recorded(fleet, driven(fleet))
    result = audit(recording)
    assert result.unchecked == result.decided > 100
    assert result.agreeing == result.differing == 0


def test_another_seed_is_found_out(lossy: list[Sent]) -> None:
    result = audit(recorded(trio('[faults]\nseed = 1\nloss = "30%"\n'), lossy))
    # Of two independent decisions with 30 %, 42 % differ.
    assert 0.35 * result.decided < result.differing < 0.5 * result.decided
    assert result.agreeing + result.differing == result.decided
    assert len(result.differences) == 20
    first = result.differences[0]
    assert {first.recorded, first.expected} == {((0, 0),), ((LOST, -1),)}


def test_a_killed_receiver_is_no_lossy_network() -> None:
    fleet = trio(LOSSY + '[[faults.rule]]\nrobot = 3\nkill = "agent"\nat = 0.7\nfor = 0.5\n', duration=4.0)
    recording = recorded(fleet, driven(fleet))
    assert [event.what for event in recording.events] == ["kill", "start"]
    result = audit(recording)
    assert (result.differing, result.unheard, result.unrecorded) == (0, 0, 0)
    assert result.agreeing + result.unchecked == result.decided


def test_clocks_that_are_wrong_on_purpose_do_not_matter() -> None:
    fleet = trio(
        LOSSY + '[[faults.rule]]\nrobot = 2\nclock_skew = "80ms 1000ppm"\n'
        '[[faults.rule]]\nlink = "2->1"\nloss = "100%"\nat = 0.5\nfor = 0.3\n'
    )
    result = audit(recorded(fleet, driven(fleet)))
    assert result.agreeing == result.decided > 500
    assert result.unheard == 0


# --- robots without an edge -------------------------------------------------------------------

CROSSING = """
[fleet]
name = "crossing"
duration_s = 8
[formation]
offsets = [[0, 0], [0.5, 0.4], [0, 0.8]]
edges = [[1, 2], [2, 3]]
safe_distance_m = 0.22
[[robot]]
id = 1
x_m = 0
y_m = 0
[[robot]]
id = 2
x_m = 0.5
y_m = 0.4
[[robot]]
id = 3
x_m = 0
y_m = 0.8
[[robot]]
id = 4
x_m = 0
y_m = 3.2
reserve = true
[faults]
loss = "30%"
"""


@pytest.fixture(scope="module")
def joined() -> Recording:
    join = '[[order]]\nat = 1\nkind = "join"\nrobot = 4\nedges = [3]\noffset_m = [0, 1.8]\n'
    leave = '[[order]]\nat = 5\nkind = "leave"\nrobot = 4\n'
    fleet = resolved(parse_fleet(CROSSING + join + leave, source="crossing.toml"))
    return recorded(fleet, driven(fleet))


def test_who_is_near_is_audited_as_neighbours_are_and_need_not_be_heard(joined: Recording) -> None:
    heard = {(link.source, link.destination) for link, _ in joined.links.by_link()}
    assert (1, 3) in heard  # near, without an edge
    assert (4, 3) in heard
    result = audit(joined)
    assert result.agreeing + result.unchecked == result.decided > 2000
    assert result.unchecked < 0.02 * result.decided
    assert (result.differing, result.unrecorded, result.unheard) == (0, 0, 0)


def test_what_does_not_come_over_an_edge_that_was_ordered_is_missed(joined: Recording) -> None:
    links = joined.links
    lacks = (links.source == 4) & (links.destination == 3) & (links.t > 3.0) & (links.t < 4.0)
    near = (links.source == 1) & (links.destination == 3) & (links.t > 3.0) & (links.t < 4.0)
    assert near.sum() > 0
    result = audit(replace(joined, links=links[~lacks & ~near]))
    assert result.unheard == lacks.sum() == 50


# --- live rules -------------------------------------------------------------------------------

CUT = '[[faults.rule]]\nlink = "1->2"\nloss = "100%"\nname = "cut"\n'


def test_live_rules_are_proven_from_what_processes_said_they_held() -> None:
    fleet = trio(LOSSY, duration=3.0)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        origin = epoch_ns + round(0.8 * SECOND)
        sent = Faults(7, epoch_ns + SECOND // 2, "ana@lab:1", origin, 0, CUT)
        gone = Faults(8, epoch_ns + 2 * SECOND, EVERY_AUTHOR, 0, 0, "")
        return [(0.5, sent), (2.0, gone)]

    recording = recorded(fleet, driven(fleet, live))
    (held,) = live_sets(recording)
    assert (held.message.author, held.rules[0].name) == ("ana@lab:1", "cut")
    assert held.origin_s == pytest.approx(0.8)
    assert held.end_s == pytest.approx(2.0, abs=0.1)
    (span,) = spans(recording, recording.end_s)
    assert (span.author, span.start_s) == ("ana@lab:1", pytest.approx(0.8))
    link = next(rows for link, rows in recording.links.by_link() if str(link) == "1→2")
    inside = (link.t > 0.81) & (link.t < 1.95)
    assert inside.sum() > 50
    assert (link.what[inside] & LOST).all()
    result = audit(recording)
    assert (result.differing, result.unheard, result.unrecorded) == (0, 0, 0)
    assert result.agreeing > 0.98 * result.decided


def test_one_robot_does_not_say_for_all_when_live_rules_held() -> None:
    fleet = trio(LOSSY, duration=3.0)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        return [(0.5, Faults(7, epoch_ns + SECOND // 2, "ana", epoch_ns + SECOND // 2, 0, CUT))]

    recording = recorded(fleet, driven(fleet, live))
    (held,) = live_sets(recording)
    (since,) = (each for each in recording.live_faults[:1])
    gone = since.message._replace(rules="", time_ns=since.message.time_ns + SECOND)
    early = LiveFaults(since.received_ns - SECOND, 2, "agent", since.message)
    lies = replace(
        recording,
        live_faults=[early, *recording.live_faults, LiveFaults(since.received_ns, 2, "agent", gone)],
    )
    assert live_sets(lies) == [held]
    said = [LiveFaults(since.received_ns, robot, "agent", gone) for robot in (1, 2)]
    (ended,) = live_sets(replace(recording, live_faults=[*recording.live_faults, *said]))
    assert ended.end_s == pytest.approx(1.5, abs=0.1)


def test_live_rules_end_with_their_lease() -> None:
    fleet = trio(duration=3.0)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        first = Faults(7, epoch_ns + SECOND // 2, "a", epoch_ns + SECOND, SECOND, CUT)
        renewed = first._replace(time_ns=epoch_ns + SECOND)
        return [(0.5, first), (1.0, renewed)]

    recording = recorded(fleet, driven(fleet, live))
    (held,) = live_sets(recording)
    assert held.end_s == pytest.approx(2.0, abs=0.03)
    result = audit(recording)
    assert result.decided == pytest.approx(50, abs=2)
    assert result.differing == 0
    assert result.decided - 2 <= result.agreeing <= result.decided


def test_without_what_was_held_live_decisions_are_not_explained() -> None:
    fleet = trio(duration=3.0)

    def live(epoch_ns: int) -> list[tuple[float, Faults]]:
        return [(0.5, Faults(7, epoch_ns + SECOND // 2, "a", epoch_ns + SECOND, 0, CUT))]

    sent = [each for each in driven(fleet, live) if not isinstance(each[2], Faults)]
    result = audit(recorded(fleet, sent))
    assert result.differing == result.decided > 90
