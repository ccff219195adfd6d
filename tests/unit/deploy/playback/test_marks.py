"""What happened in a run is marked, and nothing that is as it should be."""

from __future__ import annotations

from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Event, Resume, StatusText, Stop
from handfast.deploy.playback.marks import FAULT, ORDER, VEHICLE, VIOLATION, Mark, marks
from handfast.deploy.recording.collector import RunData
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import FLEET, result_of
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, messages, standing

NAME = FLEET.fleet.name


def with_more(*more: tuple[int, str, object]) -> list[Mark]:
    data = RunData(FLEET)
    for sent in sorted([*messages(FLEET, in_formation(FLEET)), *more], key=lambda each: each[0]):
        data.feed(*sent)  # type: ignore[arg-type]
    return marks(RunResult(data.recording()))


def test_of_a_good_run_only_its_begin_is_marked() -> None:
    assert marks(result_of()) == [Mark(0.0, None, ORDER, "the drive begins")]


def test_orders_are_marked_when_they_were_given() -> None:
    at = EPOCH_NS + 10**9
    found = with_more(
        (at, key_expressions.stop(NAME), Stop(1, at, "a dog")),
        (at + 10**9, key_expressions.resume(NAME), Resume(2, at + 10**9, (2,))),
    )
    orders = [mark for mark in found if mark.kind == ORDER]
    assert orders[1:] == [
        Mark(1.0, None, ORDER, "stop: a dog"),
        Mark(2.0, None, ORDER, "resume: robot 2", (2,)),
    ]


def test_what_was_done_to_processes_is_marked() -> None:
    at = EPOCH_NS + 1_500_000_000
    found = with_more((at, key_expressions.events(NAME), Event(3, 0, at, "agent", "kill", "crash")))
    assert Mark(1.5, None, FAULT, "agent 3 killed", (3,)) in found


def test_what_a_vehicle_says_itself_is_marked() -> None:
    at = EPOCH_NS + 1_500_000_000
    key = key_expressions.status_texts(NAME, 2)
    found = with_more(
        (at, key, StatusText(2, 0, at, "critical", "EKF failsafe")),
        (at, key, StatusText(3, 0, at, "critical", "of another robot")),
    )
    said = "the vehicle of robot 2 says (critical): EKF failsafe"
    assert [mark for mark in found if mark.kind == VEHICLE] == [Mark(1.5, None, VEHICLE, said, (2,))]


def test_pairs_below_the_safe_distance_are_violations_that_name_them() -> None:
    near = [standing(0, 0), lambda t: (1.0 - min(max(t, 0.0), 1.5) * 0.6, 0.0, 0.0), standing(0, 1)]
    found = [mark for mark in marks(result_of(paths=near)) if mark.kind == VIOLATION]
    apart = [mark for mark in found if "apart" in mark.text]
    assert [mark.robots for mark in apart] == [(1, 2)]
    assert "0.100 m apart, less than the safe distance" in apart[0].text
