"""A run as messages of ROS 2: what each topic says, and that it is what was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import atan2, cos, hypot, pi, sin
from typing import Any

import numpy as np
import pytest

from handfast.agent.messages.types import Event, Message, Status, Stop
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.ros_messages import LATCHED, LOG, STORE, VOLATILE, Ints, Stream, streams
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.simulated_run import recorded
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Path,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)

FLEET = make_fleet(*triangle(2), duration_s=1.0, hand_offset_m=0.15)
SECOND_NS = 1_000_000_000


def turning(t: float) -> tuple[float, float, float]:
    """A body that turns through the heading where angles begin anew."""
    return 0.3 * t, -0.2, (5.9 + t) % (2 * pi)


def recording(paths: Sequence[Path] | None = None, **kinds: Any) -> Recording:
    return recorded(FLEET, messages(FLEET, list(paths or in_formation(FLEET)), **kinds))


def of(stream: Stream) -> list[Any]:
    """All messages of a stream, once it is seen that there are as many as times."""
    found = [STORE.deserialize_cdr(each, stream.type) for each in stream.messages]
    assert len(found) == len(stream.times_ns)
    assert (np.diff(stream.times_ns) >= 0).all()
    return found


def topics(source: Recording) -> dict[str, tuple[Ints, list[Any], str]]:
    """Times, messages and QoS of each topic, robot by robot where several share it."""
    found: dict[str, tuple[Ints, list[Any], str]] = {}
    for stream in streams(RunResult(source)):
        times, content, qos = found.get(stream.topic, (np.zeros(0, dtype=np.int64), [], stream.qos))
        found[stream.topic] = (np.concatenate([times, stream.times_ns]), content + of(stream), qos)
    return found


@cache
def formation() -> tuple[Recording, dict[str, tuple[Ints, list[Any], str]]]:
    source = recording()
    return source, topics(source)


def ns(stamp: Any) -> int:
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def heading(q: Any) -> float:
    assert (q.x, q.y) == (0.0, 0.0)
    assert hypot(q.z, q.w) == pytest.approx(1.0)
    return 2.0 * atan2(q.z, q.w)


def place(pose: Any) -> tuple[float, float]:
    assert pose.position.z == 0.0
    return pose.position.x, pose.position.y


def test_topics() -> None:
    _, found = formation()
    of_robots = {f"/robot_{i}/{name}" for i in (1, 2, 3) for name in ("pose", "odom", "path", "wanted")}
    errors = {f"/edge_{pair}/error" for pair in ("1_2", "1_3", "2_3")}
    alone = {
        "/tf", "/tf_static", "/diagnostics", "/rosout", "/edges", "/formation_error", "/min_distance",
    }  # fmt: skip
    assert set(found) == of_robots | errors | alone
    latched = {topic for topic, (_, _, qos) in found.items() if qos == LATCHED}
    assert latched == {"/tf_static", "/robot_1/path", "/robot_2/path", "/robot_3/path"}
    assert {topic for topic, (_, _, qos) in found.items() if qos == LOG} == {"/rosout"}
    assert {qos for _, _, qos in found.values()} == {VOLATILE, LATCHED, LOG}


def test_bag_and_header_have_the_real_time() -> None:
    source, found = formation()
    times, poses, _ = found["/robot_2/pose"]
    assert times.tolist() == source.robots[2].plant.stamps_ns.tolist()
    assert times[0] == EPOCH_NS - 200_000_000
    stamped = ["/robot_2/odom", "/robot_2/path", "/robot_2/wanted", "/diagnostics"]
    assert [ns(pose.header.stamp) for pose in poses] == times.tolist()
    for topic in stamped:
        times, content, _ = found[topic]
        assert [ns(each.header.stamp) for each in content] == times.tolist(), topic
    for topic in ("/tf", "/tf_static"):
        times, content, _ = found[topic]
        assert [ns(each.transforms[0].header.stamp) for each in content] == times.tolist()
    times, content, _ = found["/edges"]
    assert [ns(each.markers[0].header.stamp) for each in content] == times.tolist()
    times, content, _ = found["/rosout"]
    assert [ns(each.stamp) for each in content] == times.tolist()


def test_poses_are_those_of_the_bodies() -> None:
    source, found = formation()
    for robot, data in source.robots.items():
        _, poses, _ = found[f"/robot_{robot}/pose"]
        assert {pose.header.frame_id for pose in poses} == {"map"}
        assert [place(each.pose) for each in poses] == list(
            zip(data.body["x"].tolist(), data.body["y"].tolist(), strict=True)
        )
        turned = [heading(each.pose.orientation) for each in poses]
        assert np.cos(turned) == pytest.approx(np.cos(data.body["heading"]))
        assert np.sin(turned) == pytest.approx(np.sin(data.body["heading"]))


def test_frames_lead_from_the_map_to_the_hand() -> None:
    source, found = formation()
    (fixed,) = found["/tf_static"][1]
    hands = {each.child_frame_id: each for each in fixed.transforms}
    assert set(hands) == {"robot_1/hand", "robot_2/hand", "robot_3/hand"}
    times, moved, _ = found["/tf"]
    assert found["/tf_static"][0][0] == times.min()
    assert len(moved) == sum(len(data.body) for data in source.robots.values())
    grid = source.grid
    expected = source.hand_positions(grid)
    for index, robot in enumerate(source.ids):
        static = hands[f"robot_{robot}/hand"]
        assert static.header.frame_id == f"robot_{robot}/base_link"
        assert static.transform.rotation.w == 1.0
        offset = static.transform.translation.x
        assert offset == 0.15
        at: dict[int, tuple[float, float]] = {}
        for each in moved:
            (frame,) = each.transforms
            if frame.child_frame_id == static.header.frame_id:
                assert frame.header.frame_id == "map"
                turn, base = heading(frame.transform.rotation), frame.transform.translation
                at[ns(frame.header.stamp)] = base.x + offset * cos(turn), base.y + offset * sin(turn)
        for t, hand in zip(grid.tolist(), expected[:, index], strict=True):
            assert at[EPOCH_NS + round(t * 1e9)] == pytest.approx(tuple(hand), abs=1e-9)


def test_odometry_is_what_the_plant_measured() -> None:
    found = topics(recording(truth=True))
    for true, measured in zip(found["/robot_1/pose"][1], found["/robot_1/odom"][1], strict=True):
        (x, y), (seen_x, seen_y) = place(true.pose), place(measured.pose.pose)
        assert (seen_x - x, seen_y - y) == pytest.approx((0.5, -0.5))
        assert (measured.header.frame_id, measured.child_frame_id) == ("map", "robot_1/base_link")
        twist = measured.twist.twist
        assert (twist.linear.x, twist.linear.y, twist.angular.z) == (0.1, 0.0, 0.01)
        assert not measured.pose.covariance.any()
        assert not measured.twist.covariance.any()


def test_what_the_plant_itself_takes_for_wrong_is_left_out() -> None:
    sent = [
        (received, key, message._replace(healthy=message.sequence % 2 == 0))
        if key.endswith("robot/1/plant/state")
        else (received, key, message)
        for received, key, message in messages(FLEET, in_formation(FLEET))
    ]
    found = topics(recorded(FLEET, sent))
    whole = len(found["/robot_2/pose"][1])
    assert len(found["/robot_1/pose"][1]) == len(found["/robot_1/odom"][1]) == (whole + 1) // 2


def test_places_are_wanted_of_the_hand() -> None:
    source = recording(in_formation(FLEET, mess_m=0.4))
    found = topics(source)
    assert FLEET.formation.offsets is not None
    for robot, offset in zip(source.ids, FLEET.formation.offsets, strict=True):
        times, wanted, _ = found[f"/robot_{robot}/wanted"]
        assert times.tolist() == [EPOCH_NS + 20_000_000 * k for k in range(51)]
        assert {each.header.frame_id for each in wanted} == {"map"}
        assert {heading(each.pose.orientation) for each in wanted} == {0.0}
        assert [place(each.pose) for each in wanted] == [pytest.approx(offset)] * 51


def states(*told: tuple[str, str]) -> Recording:
    """Robot 1 says these states and reasons one after the other."""
    left = list(told)
    sent = []
    for received, key, message in messages(FLEET, in_formation(FLEET)):
        if isinstance(message, Status) and message.robot == 1 and left:
            state, reason = left.pop(0)
            message = message._replace(state=state, reason=reason)
        sent.append((received, key, message))
    return recorded(FLEET, sent)


def test_diagnostics() -> None:
    source = states(
        ("ready", "for a mission"), ("running", ""), ("holding", "hears nobody"), ("fault", "plant")
    )
    _, arrays, _ = topics(source)["/diagnostics"]
    (first, *_rest) = said = [each for array in arrays for each in array.status if each.name == "robot_1"]
    assert [(each.level, each.message) for each in said[:4]] == [
        (0, "ready: for a mission"),
        (0, "running"),
        (1, "holding: hears nobody"),
        (2, "fault: plant"),
    ]
    assert first.hardware_id == "robot_1"
    values = {each.key: each.value for each in first.values}
    assert values == {"state": "ready", "age_max_ms": "3", "tick_max_us": "100", "overruns": "1"}
    assert len(arrays) == sum(len(data.status) for data in source.robots.values())


def test_log() -> None:
    sent: list[tuple[int, str, Message]] = [
        (received, key, message._replace(state="holding", reason="hears nobody"))
        if isinstance(message, Status) and message.robot == 2 and message.time_ns > EPOCH_NS + 500_000_000
        else (received, key, message)
        for received, key, message in messages(FLEET, in_formation(FLEET))
    ]
    at_ns = EPOCH_NS + 300_000_000
    sent.append((at_ns, "made-up/events", Event(3, 1, at_ns, "agent", "kill", "crash")))
    sent.append((at_ns, "made-up/stop", Stop(1, at_ns + 100_000_000, "enough")))
    times, lines, _ = topics(recorded(FLEET, sent))["/rosout"]
    said = {
        (each.name, each.msg): (each.level, time) for time, each in zip(times.tolist(), lines, strict=True)
    }
    assert said["operator", "the drive begins"] == (20, EPOCH_NS)
    assert said["operator", "stop: enough"] == (20, at_ns + 100_000_000)
    assert said["faults", "agent 3 killed"] == (30, at_ns)
    assert said["robot_2", "running"] == (20, EPOCH_NS)
    assert said["robot_2", "holding: hears nobody"] == (30, EPOCH_NS + 600_000_000)
    assert ("robot_2", "holding: hears nobody") in said
    assert len([name for name, _ in said if name.startswith("robot_")]) == 4


def test_a_violation_is_an_error() -> None:
    _, lines, _ = topics(recording([standing(0, 0), turning, standing(0, 2)]))["/rosout"]
    unsafe = [each for each in lines if each.name == "verdict" and "robots 1 and 2" in each.msg]
    assert not unsafe  # they begin too near

    def near(t: float) -> tuple[float, float, float]:
        return (1.0 if t < 0.5 else 0.1), 0.0, 0.0

    _, lines, _ = topics(recording([standing(0, 0), near, standing(0, 2)]))["/rosout"]
    (unsafe, *_rest) = [each for each in lines if each.name == "verdict" and "robots 1 and 2" in each.msg]
    assert unsafe.level == 40


def test_edges_are_lines_between_hands() -> None:
    times, arrays, _ = topics(recording([standing(0, 0), standing(1, 0), standing(0.0, 0.1)]))["/edges"]
    assert np.diff(times).tolist() == [100_000_000] * 10
    (marker,) = arrays[0].markers
    assert (marker.header.frame_id, marker.type, marker.action) == ("map", marker.LINE_LIST, marker.ADD)
    lines = [((a.x, a.y), (b.x, b.y)) for a, b in zip(marker.points[::2], marker.points[1::2], strict=True)]
    assert lines == [((0.15, 0), (1.15, 0)), ((0.15, 0), (0.15, 0.1)), ((1.15, 0), (0.15, 0.1))]
    colors = [(each.r > 0.5, each.g > 0.5) for each in marker.colors]
    holds, off, unsafe = (False, True), (True, True), (True, False)
    # 1-2 has its distance, 1-3 is below the safe one, 2-3 within 5 % of its own.
    assert colors == [holds, holds, unsafe, unsafe, holds, holds]
    _, arrays, _ = topics(recording([standing(0, 0), standing(2, 0), standing(0.5, 0.9)]))["/edges"]
    assert [(each.r > 0.5, each.g > 0.5) for each in arrays[0].markers[0].colors[:2]] == [off, off]
