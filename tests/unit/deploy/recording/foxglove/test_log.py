"""The log: each thing that happens, once."""

from __future__ import annotations

import json

from handfast.agent.messages.types import EVENTS, EVERY_AUTHOR, Event, Faults, Mission, Resume, Status, Stop
from handfast.deploy.faults.process_actions import WORDS
from handfast.deploy.recording.foxglove.json_text import stamped
from handfast.deploy.recording.foxglove.log import _WORDS as OURS
from handfast.deploy.recording.foxglove.log import Log

INFO, WARNING, ERROR = 2, 3, 4


def said(log: Log) -> list[tuple[int, str, str]]:
    values = [json.loads(stamped(line, 7)) for line in log.lines]
    log.lines = []
    assert all(value["timestamp"] == {"sec": 0, "nsec": 7} for value in values)
    return [(value["level"], value["name"], value["message"]) for value in values]


def test_states_have_the_level_of_their_look() -> None:
    log = Log(0.2)
    for state, reason in (("running", ""), ("holding", "hears nobody"), ("fault", "lost")):
        log.status(Status(4, 0, 0, state, "", reason, 1, 0, (), (), (), ()))
    assert said(log) == [
        (INFO, "robot 4", "running"),
        (WARNING, "robot 4", "holding: hears nobody"),
        (ERROR, "robot 4", "fault: lost"),
    ]


def test_orders_are_said_once_however_often_they_are_relayed() -> None:
    log = Log(0.2)
    for _ in range(3):
        log.order(Stop(3, 0, 'dog on the "field"\n'))
    log.order(Resume(4, 0, ()))
    log.order(Stop(3, 5, ""))
    log.order(Resume(5, 0, (2, 3)))
    log.mission(Mission(1, 0, 0, 20 * 10**9, ""))
    log.mission(Mission(2, 0, 0, 20 * 10**9, "", note="robot 3 leaves"))
    assert said(log) == [
        (WARNING, "operator", 'stop: dog on the "field"\n'),
        (INFO, "operator", "resume: all robots"),
        (INFO, "operator", "resume: robots 2 and 3"),
        (INFO, "operator", "mission: a drive of 20 s"),
        (INFO, "operator", "mission: robot 3 leaves"),
    ]


def test_live_faults_are_said_when_they_change() -> None:
    log = Log(0.2)
    rules = "[[faults.rules]]\nloss = 0.3\n"
    log.faults(Faults(0, 0, "nobody", 0, 0, ""))  # there never were any
    for version, text in ((1, rules), (1, rules), (2, ""), (1, rules)):
        log.faults(Faults(version, 0, "anna", 0, 0, text))
    log.faults(Faults(2, 0, EVERY_AUTHOR, 0, 0, ""))
    assert said(log) == [
        (WARNING, "faults", "live faults of anna: [[faults.rules]] loss = 0.3"),
        (INFO, "faults", "live faults of anna are cleared"),
    ]


def test_what_is_done_to_processes_is_said_in_the_words_of_the_report() -> None:
    assert OURS == WORDS
    assert set(OURS) == set(EVENTS)
    log = Log(0.2)
    log.event(Event(2, 0, 0, "plant", "kill", "crash"))
    log.event(Event(2, 1, 0, "plant", "start", ""))
    assert said(log) == [
        (WARNING, "faults", "plant of robot 2 killed (crash)"),
        (WARNING, "faults", "plant of robot 2 started"),
    ]


def test_two_that_come_too_close_are_said_once_until_they_are_well_apart() -> None:
    log = Log(0.2)

    def at(distance: float) -> None:
        close = {(1, 2): distance} if distance < 0.2 else {}
        log.distances(close, {1: (0.0, 0.0), 2: (distance, 0.0)})

    for distance in (0.3, 0.19, 0.15, 0.205, 0.18, 0.22, 0.19):
        at(distance)
    assert said(log) == [
        (ERROR, "safety", "robots 1 and 2 are 0.190 m apart, less than the safe distance of 0.200 m"),
        (INFO, "safety", "robots 1 and 2 are apart again; they were 0.150 m apart"),
        (ERROR, "safety", "robots 1 and 2 are 0.190 m apart, less than the safe distance of 0.200 m"),
    ]
    log.distances({}, {1: (0.0, 0.0)})
    at(0.19)
    assert len(said(log)) == 1, "its body was carried off, and came again"
