"""What pages are told of a fleet is what it says, each thing once, and of a new drive from its begin."""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import isnan
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message, PlantState, Stop
from handfast.deploy.playback.marks import LOOKS, SILENT
from handfast.deploy.playback.scene import COLUMNS
from handfast.deploy.view.live_fleet import (
    FORCE_COLUMNS,
    FRAME_NS,
    HEAD,
    HISTORY_COLUMNS,
    PANEL_NS,
)
from handfast.deploy.view.motion import SILENT_NS
from tests.unit.deploy.view.running import FLEET, NAME, Running, heard_of

AT = {name: index for index, name in enumerate(COLUMNS)}
SAFE_M = FLEET.formation.safe_distance_m


@pytest.fixture
def running() -> Iterator[Running]:
    with Running() as made:
        yield made


def parted(running: Running, name: str) -> Any:
    return json.loads(running.live.parts[name][1])


def events(running: Running, kind: str) -> list[str]:
    return [each["text"] for each in running.live.logs["events"] if each["kind"] == kind]


def states(running: Running, robot: int) -> list[tuple[float, str, str]]:
    """Those of one robot: fleet time, state and why."""
    index = FLEET.ids.index(robot)
    return [(t, state, why) for t, whose, state, why in running.live.logs["states"] if whose == index]


def rows(frame: bytes) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    columns = HEAD.unpack_from(frame)[3]
    return np.frombuffer(frame, dtype="<f4", offset=HEAD.size).reshape(-1, columns)


def test_a_scene_says_what_a_row_holds(running: Running) -> None:
    scene = parted(running, "scene")
    assert scene["columns"] == list(COLUMNS)
    assert scene["frame_columns"] == len(COLUMNS) - FORCE_COLUMNS
    assert scene["columns"][-FORCE_COLUMNS:] == [
        "navigation_x",
        "navigation_y",
        "constraint_x",
        "constraint_y",
    ]
    assert [robot["id"] for robot in scene["robots"]] == list(FLEET.ids)
    assert SILENT in LOOKS


# ---------------------------------------------------------------------- frames


def test_a_frame_has_a_head_and_a_row_of_each_robot(running: Running) -> None:
    running.body(3, 2.0, 1.0, 0.5)
    running.hand(3, (1.0, 2.0, 3.0, 4.0))
    running.step()
    short, full = running.live.frame(forces=False), running.live.frame(forces=True)
    t_s, made_s, number, columns = HEAD.unpack_from(short)
    assert isnan(t_s)
    assert made_s == pytest.approx(running.clock.ns / NS_PER_S)
    assert (number, columns) == (1, len(COLUMNS) - FORCE_COLUMNS)
    assert HEAD.unpack_from(full)[3] == len(COLUMNS)
    assert rows(short).shape == (len(FLEET.ids), len(COLUMNS) - FORCE_COLUMNS)
    np.testing.assert_array_equal(rows(short), rows(full)[:, :-FORCE_COLUMNS])
    row = rows(full)[FLEET.ids.index(3)]
    assert row[AT["heading"]] == 0.5
    assert row[-FORCE_COLUMNS:].tolist() == [1, 2, 3, 4]
    assert np.isnan(rows(full)[0, :4]).all()


def test_the_past_of_a_drive_is_all_frames_since_its_start(running: Running) -> None:
    running.step()
    assert len(running.live.history) == 0  # there is no drive
    running.begin(since_s=-0.12)
    for x in range(6):
        running.body(1, x)
        running.step(FRAME_NS)
    past = running.live.until_now()
    assert HEAD.unpack_from(past)[2:] == (1, HISTORY_COLUMNS)
    width = len(FLEET.ids) * (len(COLUMNS) - FORCE_COLUMNS)
    found = np.frombuffer(past, dtype="<f4", offset=HEAD.size).reshape(-1, width + 1)
    assert found[:, 0] == pytest.approx([0.03, 0.08, 0.13, 0.18], abs=1e-3)
    assert np.diff(found[:, 1]) == pytest.approx([1, 1, 1])
    newest = rows(running.live.frame(forces=False)).reshape(-1)
    np.testing.assert_array_equal(found[-1, 1:], newest)


def test_of_each_body_the_newest_state_is_taken(running: Running) -> None:
    told: list[float] = []

    def note(_: int, key: str, message: Message) -> None:
        if type(message) is PlantState:
            told.append(message.x)

    running.live.listeners.append(note)
    for x in range(5):
        running.body(1, float(x))
        running.body(2, 10.0 + x)
    running.step()
    assert told == [4.0, 14.0]


# ---------------------------------------------------------------------- logs


def test_who_says_nothing_any_more_is_silent_and_nowhere(running: Running) -> None:
    running.begin()
    running.come()
    for _ in range(3):
        for robot in (1, 2):
            running.status(robot, "running")
            running.body(robot)
        running.step(PANEL_NS)
    assert not np.isnan(rows(running.live.frame(forces=False))[:2, :4]).any()
    for _ in range(SILENT_NS // PANEL_NS + 1):
        running.status(2, "running")
        running.body(2)
        running.step(PANEL_NS)
    shown = rows(running.live.frame(forces=False))
    assert np.isnan(shown[0, :4]).all()
    assert not np.isnan(shown[1, :4]).any()
    assert states(running, 1)[-1][1] == SILENT
    assert states(running, 1)[-1][2].startswith("has said nothing for ")
    count = len(states(running, 1))
    for _ in range(3):
        running.step(1)  # what it said last is not its state again, nor is it silent once more
    assert len(states(running, 1)) == count
    assert SILENT not in {state for t, state, _ in states(running, 2) if t > 10.6}
    running.status(1, "running")
    running.step(PANEL_NS)
    assert states(running, 1)[-1][1:] == ("running", "")


def test_what_is_ordered_and_what_comes_of_it_is_marked_once(running: Running) -> None:
    running.begin()
    for robot in (1, 2):
        running.status(robot, "running")
    running.step()
    running.bus.put(key_expressions.stop(NAME), Stop(3, running.clock.ns, "a person"))
    running.status(1, "degraded", "without robot 2")
    running.step()
    running.step()
    assert events(running, "order") == ["every robot is told to stop: a person"]
    assert events(running, "state") == ["robot 1 is degraded: without robot 2"]
    (mark,) = [each for each in running.live.logs["events"] if each["kind"] == "state"]
    assert (mark["t_s"], mark["end_s"], mark["robots"]) == (pytest.approx(10.1), None, (1,))


# ---------------------------------------------------------------------- parts


def test_the_panel_says_how_the_fleet_stands(running: Running) -> None:
    mission = running.begin()
    running.come(1, 2, 3)
    for robot in FLEET.ids:
        running.status(robot, "stopped", "stop: a person", order_version=3)
        running.body(robot, 3.0 * robot, note="battery low" if robot == 2 else "")
    running.bus.put(key_expressions.stop(NAME), Stop(3, running.clock.ns, "a person"))
    running.step(PANEL_NS)
    panel = parted(running, "panel")
    assert panel["duration_s"] == 60.0
    assert panel["mission"] == mission.note
    assert panel["stop"].startswith("stopped at ")
    assert panel["stop"].endswith(": a person")
    assert panel["members"] == [1, 2, 3, 4]
    assert panel["present"] == [6, 12]
    assert panel["notes"] == {"2": "battery low"}
    assert panel["lacking"]["order"] == []


def test_links_are_as_who_hears_says(running: Running) -> None:
    running.status(1, neighbours=(heard_of(2), heard_of(3, age_us=-1, received=0, lost=0)))
    running.step(PANEL_NS)
    assert parted(running, "links") == [[2, 1, 20, 9, 1, 3], [3, 1, -1, 0, 0, 3]]


# ---------------------------------------------------------------------- another drive


def test_another_epoch_is_another_drive_of_which_nothing_is_told_yet(running: Running) -> None:
    running.begin(version=1, since_s=50.0)
    running.come()
    for _ in range(4):
        running.status(1, "degraded", "without robot 2")
        running.body(1, 0.0)
        running.body(2, SAFE_M / 2)
        running.step(PANEL_NS)
    assert (running.live.drive, len(running.live.history)) == (1, 4)
    assert events(running, "violation")
    running.begin(version=2, since_s=-1.0)
    running.step()
    assert (running.live.drive, len(running.live.history)) == (2, 0)
    assert events(running, "state") == []
    assert [each[1:] for each in states(running, 1)] == [("degraded", "without robot 2")]
    assert states(running, 1)[0][0] == pytest.approx(-0.95)
    assert len(running.live.logs["edges"]) == 1
    assert len(events(running, "violation")) == 1  # they are too near in this drive, too
