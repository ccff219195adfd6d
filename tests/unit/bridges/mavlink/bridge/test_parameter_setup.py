"""Parameters of simulated rovers, read, set and read back in virtual time."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from agent.common.time import NS_PER_S
from agent.fleet.mavlink_section import MavlinkSection
from bridges.mavlink.bridge.parameter_audit import LOOKED_AT, changes
from bridges.mavlink.bridge.parameter_setup import (
    LOST,
    PERIOD_NS,
    SET_MAX,
    UNREAD,
    Answer,
    ParameterSetup,
    Task,
    answers_of,
    tasks_of,
    tasks_to_json,
)
from bridges.mavlink.session.settings import session_settings
from bridges.mavlink.simulator.settings import settings_of
from tests.rover_scene import START_NS, World, rovers

LOOK = Task(LOOKED_AT)
NAMES = ("FS_CRASH_CHECK", "BATT_FS_LOW_ACT", "FS_EKF_THRESH")
SET = Task(NAMES, {"FS_CRASH_CHECK": (0.0, 1.0), "BATT_FS_LOW_ACT": (0.0, 2.0), "FS_EKF_THRESH": (0.0, 0.8)})


class Bench:
    """A setup at a port of a rover that is switched on and disarmed, unless `settings` say otherwise."""

    def __init__(self, task: Task, *, system: int | None = None, **settings: Any) -> None:
        common = replace(
            settings_of(rovers(), 1), hand_over=False, parameters={"FS_EKF_THRESH": 0.0}, **settings
        )
        self.world = World(common)
        self.rover, self.port = self.world.rover, self.world.ports[0]
        section = MavlinkSection(system=system)
        self.setup = ParameterSetup(session_settings(section, 7, parameters=task.names), self.port, task)

    def run(self, each: Callable[[], object] = lambda: None) -> Answer:
        """Until there is an answer; `each` is called after every step."""
        while self.setup.answer is None:
            assert self.time < 100.0
            self.step()
            each()
        return self.setup.answer

    def step(self) -> None:
        self.world.advance(self.world.now_ns + PERIOD_NS)
        self.setup.step(self.world.now_ns)

    @property
    def time(self) -> float:
        return (self.world.now_ns - START_NS) / NS_PER_S

    @property
    def parameters(self) -> Mapping[str, float]:
        return {name: self.rover._vehicle.parameters[name] for name in NAMES}

    @property
    def sent(self) -> list[Any]:
        """The PARAM_SET messages."""
        return [message for _, message in self.port.messages("PARAM_SET")]


def test_what_it_has_is_read_and_nothing_is_set() -> None:
    bench = Bench(LOOK)
    answer = bench.run()
    assert (answer.trouble, answer.system, answer.lacking) == ("", 1, {})
    assert set(answer.values) == set(LOOKED_AT)
    assert [(each.name, each.value, each.right) for each in changes(answer.values)] == [
        ("FS_EKF_THRESH", 0.0, 0.8),
        ("FS_CRASH_CHECK", 0.0, 1.0),
        ("BATT_FS_LOW_ACT", 0.0, 2.0),
    ]
    assert bench.sent == []
    assert bench.port.messages("SET_GPS_GLOBAL_ORIGIN") == []
    assert bench.time < 8.0


def test_what_watches_no_battery_and_what_depends_on_people_is_not_set() -> None:
    risky = dict.fromkeys(LOOKED_AT, 0.0) | {"FS_GCS_ENABLE": 0.0, "FS_ACTION": 1.0, "BATT_FS_CRT_ACT": 4.0}
    assert {each.name for each in changes(risky)} == {
        *("FS_ACTION", "FS_THR_ENABLE", "FS_EKF_ACTION", "FS_EKF_THRESH", "FS_CRASH_CHECK"),
        "BATT_FS_CRT_ACT",
    }  # fmt: skip
    assert changes({"FS_ACTION": None}) == []


def test_they_are_set_and_read_back() -> None:
    bench = Bench(SET)
    answer = bench.run()
    assert (answer.trouble, answer.lacking) == ("", {})
    assert answer.values == pytest.approx(
        {"FS_CRASH_CHECK": 1.0, "BATT_FS_LOW_ACT": 2.0, "FS_EKF_THRESH": 0.8}
    )
    assert bench.parameters == pytest.approx(answer.values)
    assert {(each.target_system, each.target_component) for each in bench.sent} == {(1, 1)}
    assert [each.param_id for each in bench.sent] == list(SET.wanted)
    asked = [each.param_id for _, each in bench.port.messages("PARAM_REQUEST_READ")]
    assert all(asked.count(name) == 2 for name in NAMES), "before and after"


def test_over_a_link_that_loses_much_they_are_set_again_until_it_has_them() -> None:
    bench = Bench(SET)

    def lose() -> None:
        bench.port.cut = int(bench.time * 1.5) % 2 == 1

    assert bench.run(lose).lacking == {}
    assert bench.parameters == pytest.approx(
        {"FS_CRASH_CHECK": 1.0, "BATT_FS_LOW_ACT": 2.0, "FS_EKF_THRESH": 0.8}
    )


def test_one_that_is_armed_is_left_alone() -> None:
    bench = Bench(SET)
    assert bench.rover.arm()
    assert bench.run().trouble == "it is armed: disarm it first"
    assert bench.sent == []


def test_one_that_is_armed_meanwhile_is_left_alone_from_then_on() -> None:
    bench = Bench(SET)

    def arm() -> None:
        if len(bench.sent) == 1:
            assert bench.rover.arm()

    answer = bench.run(arm)
    assert answer.values["FS_CRASH_CHECK"] == 1.0
    assert set(answer.lacking.values()) <= {"was not set: it was armed meanwhile"}
    assert len(bench.sent) + len(answer.lacking) == 3


@pytest.mark.parametrize(
    ("settings", "system", "words"),
    [
        ({"vehicle_type": 2}, None, "it is a quadrotor (MAV_TYPE 2), not a rover"),
        ({}, 9, "no vehicle with system id 9 here, but with 1 (ground rover)"),
    ],
)
def test_another_vehicle_is_named(settings: dict[str, Any], system: int | None, words: str) -> None:
    bench = Bench(SET, system=system, **settings)
    assert bench.run().trouble == words
    assert bench.sent == []


def test_one_that_does_not_answer_is_named() -> None:
    bench = Bench(SET)
    bench.port.cut = True
    assert bench.run().trouble == "no heartbeat of a vehicle yet"


def test_old_values_are_not_given_to_another_vehicle() -> None:
    bench = Bench(SET._replace(system=4))
    assert bench.run().trouble == "it is system 1, and its old values are those of system 4: another vehicle"
    assert bench.sent == []


def test_what_was_changed_since_it_was_shown_is_left_alone() -> None:
    bench = Bench(SET)
    bench.rover.set_parameter("FS_CRASH_CHECK", 2.0)
    answer = bench.run()
    assert answer.lacking == {"FS_CRASH_CHECK": "is 2 by now, not 0: left alone"}
    assert bench.parameters == pytest.approx(
        {"FS_CRASH_CHECK": 2.0, "BATT_FS_LOW_ACT": 2.0, "FS_EKF_THRESH": 0.8}
    )


def test_one_that_keeps_its_value_is_named() -> None:
    bench = Bench(SET)

    def keep() -> None:
        bench.rover.set_parameter("FS_CRASH_CHECK", 0.0)

    answer = bench.run(keep)
    assert answer.lacking == {"FS_CRASH_CHECK": "was sent, and it keeps 0"}
    assert len([each for each in bench.sent if each.param_id == "FS_CRASH_CHECK"]) <= SET_MAX


def test_one_that_goes_silent_after_it_was_sent_is_said_to_be_unknown() -> None:
    bench = Bench(SET)

    def cut() -> None:
        bench.port.cut = bool(bench.sent)

    answer = bench.run(cut)
    assert answer.lacking["FS_CRASH_CHECK"] == LOST
    assert all("was not set" in answer.lacking[name] for name in NAMES[1:])


def test_interrupted_it_says_what_is_known() -> None:
    bench = Bench(SET)
    bench.step()
    assert bench.setup.interrupted().trouble == "interrupted: nothing was set"
    while not bench.sent:
        bench.step()
    assert bench.setup.interrupted().lacking["FS_EKF_THRESH"] == "was not set"


def test_interrupted_before_it_is_read_back_what_was_sent_is_unknown() -> None:
    bench = Bench(SET)
    while not bench.sent:
        bench.step()
    answer = bench.setup.interrupted()
    assert answer.lacking["FS_CRASH_CHECK"] == UNREAD
    assert answer.values["FS_CRASH_CHECK"] is None, "the value from before it was sent says nothing"
    bench.port.cut = True
    for _ in range(20):
        bench.step()
    assert bench.parameters["FS_CRASH_CHECK"] == 1.0, "and it has it"
    assert bench.setup.interrupted().lacking["FS_CRASH_CHECK"] == UNREAD


def test_interrupted_what_was_read_back_is_known() -> None:
    bench = Bench(SET)
    while len(bench.sent) < 2:
        bench.step()
    answer = bench.setup.interrupted()
    assert answer.values["FS_CRASH_CHECK"] == 1.0
    assert answer.lacking == {"BATT_FS_LOW_ACT": UNREAD, "FS_EKF_THRESH": "was not set"}


def test_interrupted_while_it_is_read_again_only_what_came_since_is_known() -> None:
    bench = Bench(SET)
    said: list[str] = []

    def keep() -> None:
        if bench.sent and bench.setup.answer is None:
            bench.rover.set_parameter("FS_CRASH_CHECK", 0.0)
            why = bench.setup.interrupted().lacking.get("FS_CRASH_CHECK", "has it")
            said.extend([why] if said[-1:] != [why] else [])

    bench.run(keep)
    assert said[-2:] == [UNREAD, "was sent, and it keeps 0"]
    assert said[0] == UNREAD


def test_a_value_that_makes_no_sense_is_not_sent() -> None:
    bench = Bench(Task(("FS_EKF_THRESH",), {"FS_EKF_THRESH": (0.0, float("nan"))}))
    assert bench.run().lacking == {"FS_EKF_THRESH": "was not set"}
    assert bench.sent == []
    assert mavlink.MAV_PARAM_TYPE_REAL32 == 9


def test_tasks_and_answers_are_the_same_after_a_way_as_json() -> None:
    tasks = {1: SET, 3: LOOK._replace(system=3)}
    assert tasks_of(json.loads(json.dumps(tasks_to_json(tasks)))) == tasks
    answers = {1: Answer("", 1, {"A": 1.0, "B": None}, {"B": "why"}), 2: Answer("it is armed")}
    told = json.loads(json.dumps({robot: answer._asdict() for robot, answer in answers.items()}))
    assert answers_of(told) == answers
    for wrong in ({"1": {}}, {"x": {"names": [], "wanted": {}, "system": None}}, []):
        with pytest.raises((ValueError, LookupError, TypeError, AttributeError)):
            tasks_of(wrong)
