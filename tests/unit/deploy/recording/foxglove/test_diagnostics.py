"""Diagnostics: the level by the look of a state, and what to know of a robot."""

from __future__ import annotations

import json
from typing import Any

from handfast.agent.messages.types import PlantState, Status
from handfast.agent.supervision.state_machine import State
from handfast.deploy.playback.looks import DRIVES, FAILED, LOOKS, RESTS, TROUBLED, UNREADY
from handfast.deploy.recording.foxglove.diagnostics import ERROR, OK, STALE, WARN, diagnostics, level_of
from handfast.deploy.recording.foxglove.json_text import stamped

STATUS = Status(3, 0, 0, "fault", "", "the plant is silent", 7, 0, (), (), (), (("overruns", 4),))


def rows(*args: Any) -> Any:
    value = json.loads(stamped(diagnostics(*args), 2_000_000_001))
    assert value["header"] == {"stamp": {"sec": 2, "nsec": 1}, "frame_id": ""}
    return value["status"]


def test_levels_are_as_states_look_on_the_page() -> None:
    levels = {DRIVES: OK, RESTS: OK, UNREADY: OK, TROUBLED: WARN, FAILED: ERROR}
    assert {state.value: level_of(state.value) for state in State} == {
        state.value: levels[LOOKS[state.value]] for state in State
    }
    assert level_of("of a later version") == WARN


def test_a_row_says_what_its_robot_does_and_why() -> None:
    (row,) = rows({3: STATUS}, {}, ())
    assert row == {
        "level": ERROR, "name": "agent", "message": "fault: the plant is silent", "hardware_id": "robot 3",
        "values": [
            {"key": "body", "value": "not heard"},
            {"key": "mission", "value": "7"},
            {"key": "missed ticks", "value": "4"},
        ],
    }  # fmt: skip


def test_a_body_drives_or_brakes_or_says_what_is_wrong() -> None:
    body = PlantState(3, 0, 0, *(0.0,) * 7, True, True, True, "")
    states = (body, body._replace(driving=False), body._replace(obeying=False, note="MANUAL"))
    assert [rows({3: STATUS}, {3: each}, ())[0]["values"][0]["value"] for each in states] == [
        "drives", "brakes", "MANUAL",
    ]  # fmt: skip


def test_who_is_not_heard_is_stale_and_robots_are_in_order() -> None:
    first, last = rows({3: STATUS, 1: STATUS._replace(robot=1)}, {}, {3})
    assert [each["hardware_id"] for each in (first, last)] == ["robot 1", "robot 3"]
    assert (first["level"], last["level"]) == (ERROR, STALE)
    assert last["message"] == "not heard, was fault: the plant is silent"
