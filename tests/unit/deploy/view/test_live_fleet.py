"""What pages are told of a fleet is what it says, each thing once, and of a new drive from its begin."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from math import isnan
from typing import Any

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Message, PlantState, Stop, Wrench
from handfast.deploy.playback.looks import LOOKS, SILENT
from handfast.deploy.playback.track import COLUMNS
from handfast.deploy.session.session import valid
from handfast.deploy.view import live_fleet
from handfast.deploy.view.live_fleet import (
    APART,
    BLEND_NS,
    FORCE_COLUMNS,
    FRAME_NS,
    HEAD,
    HISTORY_COLUMNS,
    PANEL_NS,
)
from handfast.deploy.view.motion import SILENT_NS
from tests.unit.deploy.orders.order_fleets import S, after, first_plan, order, square
from tests.unit.deploy.view.running import FLEET, NAME, START, Running, heard_of

AT = {name: index for index, name in enumerate(COLUMNS)}
OF_OPERATORS = (key_expressions.mission, key_expressions.stop, key_expressions.resume)
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


def test_a_frame_has_the_time_of_its_drive(running: Running) -> None:
    running.begin(since_s=10.0)
    running.step(0)
    t_s, *_, number, _ = HEAD.unpack_from(running.live.frame(forces=False))
    assert (t_s, number) == (10.0, 1)
    running.step(FRAME_NS)
    t_s, *_, number, _ = HEAD.unpack_from(running.live.frame(forces=False))
    assert (t_s, number) == (10.05, 2)


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


def test_what_no_page_shows_is_not_decoded(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[bytes] = []

    def read_it(payload: bytes) -> Message | None:
        read.append(payload)
        return valid(payload)

    monkeypatch.setattr(live_fleet, "valid", read_it)
    told: list[str] = []
    running.live.listeners.append(lambda _now, key, _message: told.append(key))
    running.bus.put(key_expressions.wrench(NAME, 1), Wrench(1, 2**40, START, 0.0, 0.0, False))
    running.bus.put(key_expressions.links(NAME, 1), b"a trace of an agent's links")
    running.bus.put(key_expressions.plant_links(NAME, 1), b"a trace of a plant's links")
    running.bus.put(key_expressions.status(NAME, 1), b"no message")
    running.body(1)
    running.step()
    assert len(read) == 2
    assert told == [key_expressions.plant_state(NAME, 1)]


def test_hand_states_are_heard_from_when_somebody_wants_forces() -> None:
    """They are as much as all the rest; through routers nothing else says where robots are."""
    hands = key_expressions.hand(NAME, "*")
    with Running() as running:
        assert hands not in running.bus.subscribed
        assert key_expressions.everything(NAME) not in running.bus.subscribed
        for _ in range(2):
            running.live.want_forces()
        assert running.bus.subscribed.count(hands) == 1
    with Running(resolved(square("network.topology=routed"))) as running:
        assert running.bus.subscribed == [key_expressions.everything(NAME)]
        running.live.want_forces()
        assert running.bus.subscribed == [key_expressions.everything(NAME)]


def test_all_that_is_shown_is_listened_to() -> None:
    """What each robot and each operator says: but for what is not decoded, what was done on purpose, and
    questions."""
    with Running() as running:
        heard = {re.compile(key.replace("*", "[0-9]+")) for key in running.bus.subscribed}
    said = {*key_expressions.published(NAME, 3), *(key(NAME) for key in OF_OPERATORS)}
    unheard = {key for key in said if not any(pattern.fullmatch(key) for pattern in heard)}
    assert unheard == {
        key_expressions.hand(NAME, 3),
        key_expressions.wrench(NAME, 3),
        key_expressions.links(NAME, 3),
        key_expressions.plant_links(NAME, 3),
    }


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


def test_each_state_is_told_once(running: Running) -> None:
    running.begin()
    running.come()
    running.status(1, "ready")
    running.step()
    for reason in ("", "", "without robot 2", "without robot 2", ""):
        running.status(1, "degraded" if reason else "running", reason)
        running.step()
    running.status(2, "running")
    running.step()
    told = states(running, 1)
    assert [each[1:] for each in told if each[1] != SILENT] == [
        ("ready", ""),
        ("running", ""),
        ("degraded", "without robot 2"),
        ("running", ""),
    ]
    assert [t for t, *_ in told] == sorted(t for t, *_ in told)
    assert told[-1][0] == pytest.approx(10.3)


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


def test_one_to_whom_there_is_no_connection_is_silent_and_nowhere(running: Running) -> None:
    running.begin()
    running.come()
    for robot in (1, 2):
        running.status(robot, "running")
        running.body(robot)
    running.step(PANEL_NS)
    assert states(running, 1)[-1][1] == "running"
    for role in key_expressions.ROLES:
        running.bus.connect(1, role, here=False)
    running.step(PANEL_NS)
    assert states(running, 1)[-1][1:] == (SILENT, "no connection to its agent")
    assert np.isnan(rows(running.live.frame(forces=False))[0, :4]).all()
    assert not np.isnan(rows(running.live.frame(forces=False))[1, :4]).any()
    assert "no connection to robot 1's agent, robot 1's plant" in events(running, "fault")
    running.come(1)
    running.status(1, "running")
    running.step(PANEL_NS)
    assert states(running, 1)[-1][1:] == ("running", "")
    assert any(text.startswith("connected again: robot 1's") for text in events(running, "fault"))


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


def approach(running: Running, *apart_m: float) -> list[str]:
    for x in apart_m:
        running.body(1, 0.0)
        running.body(2, x)
        running.step()
    return events(running, "violation")


def test_two_that_come_too_near_are_marked_once(running: Running) -> None:
    running.begin()
    wobble_m = SAFE_M * (1 + APART) / 2
    near = approach(running, 1.0, SAFE_M * 1.001, SAFE_M * 0.9, SAFE_M * 0.8, wobble_m, SAFE_M * 0.9)
    assert near == ["robots 1 and 2 0.180 m apart, less than the safe distance of 0.200 m"]
    (mark,) = [each for each in running.live.logs["events"] if each["kind"] == "violation"]
    assert mark["robots"] == (1, 2)
    assert len(approach(running, SAFE_M * APART * 1.001)) == 1
    assert len(approach(running, SAFE_M * 0.95)) == 2


def test_what_was_ordered_before_anybody_looked_is_marked_when_it_was(running: Running) -> None:
    running.begin(since_s=10.0)
    running.bus.put(key_expressions.stop(NAME), Stop(3, running.clock.ns - 4 * S, "a person"))
    running.step()
    (mark,) = [each for each in running.live.logs["events"] if each["kind"] == "order"]
    assert mark["t_s"] == pytest.approx(6.0, abs=0.01)


def test_more_events_than_are_kept_are_left_out_and_that_is_said(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_fleet, "EVENTS_MAX", 3)
    running.begin()
    for number in range(6):
        running.bus.put(key_expressions.stop(NAME), Stop(number + 3, running.clock.ns, f"number {number}"))
        running.step()
    texts = [each["text"] for each in running.live.logs["events"]]
    assert texts == [
        *(f"every robot is told to stop: number {number}" for number in range(3)),
        "more happened than is kept here",
    ]


def test_edges_are_told_when_they_change(running: Running) -> None:
    """With a mission, and as long as one blends into the other."""
    plan = first_plan(FLEET)
    running.bus.put(key_expressions.mission(NAME), plan.mission)
    for _ in range(30):
        running.step()
    log = running.live.logs["edges"]
    assert len(log) == 1
    assert {(i, j) for i, j, _ in log[0][1]} == {(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)}
    at_s = (running.clock.ns - plan.mission.epoch_ns) / S
    wider, _ = after(order("reshape", scale=1.5), plan, FLEET, at_s=at_s)
    running.bus.put(key_expressions.mission(NAME), wider)
    begin_s = (wider.from_ns - wider.epoch_ns) / S
    end_s = begin_s + wider.blend_ns / S
    while running.state.time_s is not None and running.state.time_s < end_s + 3.0:
        running.step()
    changed = [t for t, _ in log[1:]]
    assert begin_s <= changed[0] < begin_s + BLEND_NS / S + 0.1
    assert end_s - 0.3 < changed[-1] < end_s + 0.3
    assert len(changed) == pytest.approx(wider.blend_ns / BLEND_NS, abs=3)
    assert {wanted for _, _, wanted in log[-1][1]} == {1.5, 2.121}


# ---------------------------------------------------------------------- parts


def test_a_part_has_another_version_only_when_it_has_changed(running: Running) -> None:
    live = running.live
    live.put("orders", [])
    version, text = live.parts["orders"]
    live.put("orders", [])
    assert live.parts["orders"] == (version, text)
    live.put("orders", [1])
    assert live.parts["orders"] == (version + 1, "[1]")


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


def test_a_reason_that_counts_is_one_change_and_told_as_it_is_now(running: Running) -> None:
    running.begin()
    running.come()
    for seconds in ("0.21", "0.71", "1.21"):
        running.status(1, "fault", f"plant silent for {seconds} s")
        running.status(2, "running")
        running.step(PANEL_NS)
    assert [why for _, state, why in states(running, 1) if state == "fault"] == ["plant silent for 0.21 s"]
    assert parted(running, "panel")["why"]["1"] == ["fault", "plant silent for 1.21 s"]
    assert "2" not in parted(running, "panel")["why"]


def test_links_are_as_who_hears_says(running: Running) -> None:
    running.status(1, neighbours=(heard_of(2), heard_of(3, age_us=-1, received=0, lost=0)))
    running.step(PANEL_NS)
    assert parted(running, "links") == [[2, 1, 20, 9, 1, 3], [3, 1, -1, 0, 0, 3]]


def test_what_changes_slowly_is_looked_at_seldom(running: Running) -> None:
    running.status(1, neighbours=(heard_of(2),))
    running.step()
    before = running.live.parts["links"]
    running.status(1, neighbours=(heard_of(2, lost=5),))
    running.step(PANEL_NS // 2)
    assert running.live.parts["links"] == before
    running.step(PANEL_NS // 2)
    assert parted(running, "links")[0][4] == 5


# ---------------------------------------------------------------------- another drive


def test_another_mission_of_the_same_drive_changes_nothing(running: Running) -> None:
    plan = first_plan(FLEET)
    running.bus.put(key_expressions.mission(NAME), plan.mission)
    running.status(1, "running")
    running.step()
    drive, kept = running.live.drive, len(running.live.history)
    wider, _ = after(order("reshape", scale=1.5), plan, FLEET, at_s=100.0)
    running.bus.put(key_expressions.mission(NAME), wider)
    running.step()
    assert running.live.drive == drive == 1
    assert len(running.live.history) == kept + 1
    assert states(running, 1)


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


def test_faults_that_go_on_are_marked_in_each_drive() -> None:
    with Running(resolved(square('faults.loss="10%"'))) as running:
        running.begin(version=1, since_s=50.0)
        running.step(PANEL_NS)
        assert events(running, "fault") == ["loss 10% on every link"]
        running.begin(version=2, since_s=1.0)
        for _ in range(3):
            running.step(PANEL_NS)
        assert events(running, "fault") == ["loss 10% on every link"]
