"""Reading runs back: whole, cut anywhere, damaged, and what is not a run at all."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable
from dataclasses import replace
from io import BytesIO
from math import cos, inf, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from handfast.agent.common.time import LocalTime
from handfast.agent.fleet.fault_rules import ClockError, FaultsSection, Rule
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import (
    Checks,
    Decision,
    Event,
    Faults,
    HandState,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.recorder.message_json import to_json
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.mcap_reader import read_mcap, read_run
from handfast.deploy.recording.mcap_records import MAGIC
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.recording.tables import Table
from handfast.deploy.report.export import tabulate
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    Sent,
    in_formation,
    make_fleet,
    messages,
    standing,
    triangle,
)

FLEET = make_fleet(*triangle(2), duration_s=1.6)
NAME = FLEET.fleet.name


def write_run(folder: Path, fleet: Fleet, sent: Iterable[Sent]) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "fleet.toml").write_text(tomli_w.dumps(to_dict(fleet)))
    with Recorder(folder / "run.mcap", fleet) as recorder:
        for received_ns, key, message in sent:
            recorder.record(received_ns, key, encode(message))
    return folder


def fed(fleet: Fleet, sent: Iterable[Sent]) -> Recording:
    data = RunData(fleet)
    for each in sent:
        data.feed(*each)
    return data.recording()


def assert_same(a: Recording, b: Recording) -> None:
    assert a.ids == b.ids
    assert (a.epoch_ns, list(a.missions), list(a.stops)) == (b.epoch_ns, list(b.missions), list(b.stops))
    for one, other in zip(a.robots.values(), b.robots.values(), strict=True):
        for name in ("plant", "truth", "hand", "multipliers", "wrench"):
            mine, theirs = getattr(one, name), getattr(other, name)
            assert mine.names == theirs.names
            assert np.array_equal(mine.t, theirs.t)
            assert np.array_equal(mine.values, theirs.values)
            assert np.array_equal(mine.stamps_ns, theirs.stamps_ns)
            assert np.array_equal(mine.sequences, theirs.sequences)
        for name in (
            "t", "tick_us", "tick_counts", "ages_us", "age_counts", "neighbour_counts", "mission_versions",
            "order_versions",
        ):  # fmt: skip
            assert np.array_equal(getattr(one.status, name), getattr(other.status, name))
        for name in ("states", "reasons", "transitions", "counters"):
            assert list(getattr(one.status, name)) == list(getattr(other.status, name))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a run of three robots."""
    folder = tmp_path_factory.mktemp("whole")
    write_run(folder, FLEET, messages(FLEET, in_formation(FLEET, 0.5), truth=True))
    return (folder / "run.mcap").read_bytes()


def test_fed_live_and_read_back_are_the_same(tmp_path: Path) -> None:
    sent = list(messages(FLEET, in_formation(FLEET, 0.5), truth=True))
    live = fed(FLEET, sent)
    back = read_run(write_run(tmp_path / "run", FLEET, sent))
    assert_same(live, back)
    assert np.array_equal(live.robots[1].status.neighbours, back.robots[1].status.neighbours)
    assert not back.warnings
    assert back.fleet == FLEET
    assert len(live.robots[1].plant) == 100


def test_counters_that_nobody_can_count_to_are_kept_in_bounds() -> None:
    status = Status(
        1, 7, EPOCH_NS, "running", "epoch", "", 1, 0, (), (), (), (("sent", 2**64 - 1), ("lost", -(2**63)))
    )
    sent: list[Sent] = [MISSION, (EPOCH_NS, key_expressions.status(NAME, 1), status)]
    statuses = tabulate(RunResult(fed(FLEET, sent)))["statuses"]
    assert (int(statuses["sent"][0]), int(statuses["lost"][0])) == (2**62, -(2**62))


def test_every_column_holds_what_was_sent() -> None:
    plant = PlantState(
        1, 4, EPOCH_NS + 10**9, 1.5, 2.5, 0.25, 0.5, -0.75, 3.0, 4.0, True, False, True, "dizzy"
    )
    force = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
    hand = HandState(
        1, 5, EPOCH_NS + 2 * 10**9, True, 3, 6.0, 7.0, 8.0, 9.0, *force, ((2, 1.5), (3, 2.5)), ()
    )
    wrench = Wrench(1, 6, EPOCH_NS + 3 * 10**9, 10.0, 11.0, True)
    neighbours = ((2, -1, 0, 0, 0, -1),)
    status = Status(
        1,
        7,
        EPOCH_NS + 4 * 10**9,
        "running",
        "epoch",
        "well",
        8,
        9,
        neighbours,
        (90, 95),
        (5, -1, 6),
        (("sent", 3),),
    )
    sent: list[Sent] = [
        (EPOCH_NS, key_expressions.mission(NAME), Mission(1, EPOCH_NS, EPOCH_NS, 5 * 10**9, "")),
        (EPOCH_NS, key_expressions.plant_state(NAME, 1), plant),
        (EPOCH_NS, key_expressions.hand(NAME, 1), hand),
        (EPOCH_NS, key_expressions.wrench(NAME, 1), wrench),
        (EPOCH_NS, key_expressions.status(NAME, 1), status),
    ]
    robot = fed(FLEET, sent).robots[1]

    def row(table: Table) -> dict[str, float]:
        assert len(table) == 1
        return {"t": float(table.t[0])} | {name: float(table[name][0]) for name in table.names}

    assert row(robot.plant) == {
        "t": 1.0, "x": 1.5, "y": 2.5, "heading": 0.25, "speed": 0.5, "yaw_rate": -0.75,
        "force": 3.0, "torque": 4.0, "driving": 1.0, "healthy": 0.0, "obeying": 1.0,
    }  # fmt: skip
    assert row(robot.hand) == {
        "t": 2.0, "following": 1.0, "degree": 3.0, "x": 6.0, "y": 7.0, "vx": 8.0, "vy": 9.0,
        "navigation_x": 0.1, "navigation_y": 0.2, "constraint_x": 0.3, "constraint_y": 0.4,
        "correction_x": 0.5, "correction_y": 0.6, "doubt": 0.7, "next_ms": 0.0, "stood_ms": 0.0,
            "lost_ms": 0.0,
    }  # fmt: skip
    assert row(robot.wrench) == {"t": 3.0, "force": 10.0, "torque": 11.0, "brake": 1.0, "step": 0.0}
    assert robot.multipliers.t.tolist() == [2.0, 2.0]
    assert robot.multipliers.values.tolist() == [[2.0, 1.5], [3.0, 2.5]]
    assert robot.status.t.tolist() == [4.0]
    assert robot.status.tick_us.tolist() == [90, 95]
    assert robot.status.ages_us.tolist() == [5, 6]  # a neighbour that was never heard has no age
    assert robot.status.age_counts.tolist() == [2]
    assert robot.status.totals() == {"sent": 3}
    assert (robot.status.states, robot.status.transitions) == (("running",), ("epoch",))
    assert (robot.status.mission_versions.tolist(), robot.status.order_versions.tolist()) == ([8], [9])
    assert robot.status.neighbours.tolist() == [(2, -1, 0, 0, 0, -1)]
    assert robot.status.neighbour_counts.tolist() == [1]
    assert (robot.plant.sequences.tolist(), robot.hand.sequences.tolist()) == ([4], [5])
    assert robot.wrench.stamps_ns.tolist() == [EPOCH_NS + 3 * 10**9]


# --- faults -----------------------------------------------------------------------------------

MISSION: Sent = (EPOCH_NS, key_expressions.mission(NAME), Mission(1, EPOCH_NS, EPOCH_NS, 5 * 10**9, ""))


def test_what_was_done_to_messages_is_kept_link_by_link(tmp_path: Path) -> None:
    t = EPOCH_NS + 10**9
    done = ((3, 0, 8, t, 0, 40), (1, 0, 7, t, 2, 90), (1, 0, 7, t, 0, 80), (1, 0, 6, t - 9, 1, -1))
    agent = LinkTrace(2, 0, t, tuple(map(Decision._make, done)))
    plant = LinkTrace(2, 0, t, (Decision(2, 2, 5, t, 1, -1),))
    sent: list[Sent] = [
        MISSION,
        (t, key_expressions.links(NAME, 2), agent),
        (t, key_expressions.plant_links(NAME, 2), plant),
        (t, key_expressions.links(NAME, 1), agent),  # of another robot
        (
            t,
            key_expressions.links(NAME, 2),
            agent._replace(entries=(Decision(9, 0, 8, t, 0, 40),)),
        ),  # from no robot of the fleet
    ]
    for recording in (fed(FLEET, sent), read_run(write_run(tmp_path, FLEET, sent))):
        assert recording.foreign == 2
        links = dict(recording.links.by_link())
        assert list(map(str, links)) == ["1→2", "3→2", "2→2 wrench"]
        first = links[next(iter(links))]
        assert first.sequence.tolist() == [6, 7, 7]
        assert first.what.tolist() == [1, 0, 2]
        assert first.delay_us.tolist() == [-1, 80, 90]
        assert first.first_copies.tolist() == [True, True, False]
        assert first.delivered.tolist() == [False, True, True]
        assert first.t.tolist() == pytest.approx([1.0 - 9e-9, 1.0, 1.0])


def test_live_rules_and_events_are_kept() -> None:
    t = EPOCH_NS + 10**9
    rules = Faults(7, t, "ana", t, 0, "[faults]")
    event = Event(2, 0, t, "agent", "kill", "crash")
    late = t + 3600 * 10**9
    sent: list[Sent] = [
        MISSION,
        (t, key_expressions.faults(NAME), rules),
        (
            late,
            key_expressions.faults_held(NAME, 2, "plant"),
            rules,
        ),  # said again for hours, with its old stamp
        (t, key_expressions.events(NAME), event),
        (t, key_expressions.stop(NAME), event),
        (t, key_expressions.faults_held("another", 2, "plant"), rules),
    ]
    recording = fed(FLEET, sent)
    assert [(each.received_ns, each.robot, each.role) for each in recording.live_faults] == [
        (t, 0, ""), (late, 2, "plant"),
    ]  # fmt: skip
    assert recording.events == (event,)
    assert recording.foreign == 2


def test_checks_and_leave_to_resume_are_recorded_and_are_not_foreign(tmp_path: Path) -> None:
    t = EPOCH_NS + 10**9
    checks = Checks(2, 0, t, (("EKF", "blocking", "waiting for its EKF", "open sky"),))
    resume = Resume(5, t, (2,))
    sent: list[Sent] = [
        MISSION,
        (t, key_expressions.checks(NAME, 2), checks),
        (t, key_expressions.resume(NAME), resume),
    ]
    for recording in (fed(FLEET, sent), read_run(write_run(tmp_path, FLEET, sent))):
        assert recording.foreign == 0
    stray: list[Sent] = [
        (t, key_expressions.resume(NAME), checks),
        (t, key_expressions.checks(NAME, 99), checks),
    ]
    assert fed(FLEET, [*sent, *stray]).foreign == 2


@pytest.mark.parametrize(("skew", "drift"), [(0.3, 0.0), (-900.0, 0.0), (0.1, 0.002), (0.0, -0.001)])
def test_stamps_of_a_clock_that_is_wrong_on_purpose_are_set_right(skew: float, drift: float) -> None:
    wrong = replace(FLEET, faults=FaultsSection(rules=(Rule(robot=2, clock_skew=ClockError(skew, drift)),)))
    clock = LocalTime(round(skew * 1e9), drift, EPOCH_NS)
    right = list(messages(FLEET, in_formation(FLEET, 0.5)))
    sent = [
        (t, key, message._replace(time_ns=clock.local_ns(message.time_ns)) if "robot/2/" in key else message)
        for t, key, message in right
    ]
    found, wanted = fed(wrong, sent), fed(FLEET, right)
    assert found.foreign == 0
    for name in ("plant", "hand", "multipliers", "wrench", "status"):
        mine, theirs = getattr(found.robots[2], name), getattr(wanted.robots[2], name)
        assert np.abs(mine.t - theirs.t).max() < 1e-8
    assert np.abs(found.hand_positions() - wanted.hand_positions()).max() < 1e-8
    stamps = found.robots[2].hand.stamps_ns  # but what the messages said is kept as it was
    assert stamps.tolist() == [m.time_ns for _, key, m in sent if key == key_expressions.hand(NAME, 2)]


def test_hand_points_are_ahead_of_the_pose_and_interpolated() -> None:
    """Eq. (2): r = (x + L cos, y + L sin)."""
    fleet = make_fleet([(0, 0)], [], duration_s=0.1, rate_hz=10, hand_offset_m=0.5)
    mission = Mission(1, EPOCH_NS, EPOCH_NS, 10**8, "")
    sent: list[Sent] = [(EPOCH_NS, key_expressions.mission(NAME), mission)]
    for ms, x in ((-25, 0.0), (75, 1.0), (175, 5.0)):
        state = PlantState(1, 0, EPOCH_NS + ms * 10**6, x, 2.0, pi / 6, *(0.0,) * 4, True, True, True, "")
        sent.append((state.time_ns, key_expressions.plant_state(NAME, 1), state))
    recording = fed(fleet, sent)
    assert recording.grid.tolist() == [0.0, 0.1]
    hands = recording.hand_positions()
    assert hands.shape == (2, 1, 2)
    assert hands[:, 0, 0] == pytest.approx([0.25 + 0.5 * cos(pi / 6), 2.0 + 0.5 * cos(pi / 6)])
    assert hands[:, 0, 1] == pytest.approx([2.0 + 0.5 * sin(pi / 6)] * 2)
    outside = recording.hand_positions(np.array([-9.0, 9.0]))
    assert outside[:, 0, 0] == pytest.approx([0.5 * cos(pi / 6), 5.0 + 0.5 * cos(pi / 6)])


def test_truth_is_preferred_to_measurements() -> None:
    sent = messages(FLEET, [standing(1, 2), standing(3, 4), standing(5, 6)], truth=True)
    recording = fed(FLEET, sent)  # measurements are half a metre off
    assert recording.hand_positions()[-1].tolist() == [[1.1, 2.0], [3.1, 4.0], [5.1, 6.0]]
    assert recording.robots[1].plant["x"][0] == 1.5


def test_where_no_truth_was_recorded_what_was_measured_stands_for_it() -> None:
    """As in virtual time of a vehicle: true poses come while its bridge is dead, and no others."""

    def kept(each: Sent) -> bool:
        t, is_lost = (each[0] - EPOCH_NS) / 1e9, each[1].endswith("/plant/truth")
        return not each[1].endswith(("/plant/truth", "/plant/state")) or (0.195 < t < 0.405) == is_lost

    sent = messages(make_fleet(*triangle(2), duration_s=2.0), [standing(1, 2)] * 3, truth=True)
    body = fed(FLEET, filter(kept, sent)).robots[1].body
    is_true = body["x"] == 1.0  # measurements are half a metre off
    assert ((body.t > 0.195) & (body.t < 0.405)).tolist() == is_true.tolist()
    assert 0 < is_true.sum() < len(body)
    assert (np.diff(body.t) > 0.0).all()
    assert len(body.stamps_ns) == len(body.sequences) == len(body)


def test_a_robot_that_sent_nothing_has_no_place() -> None:
    sent = [each for each in messages(FLEET, in_formation(FLEET)) if "robot/2/" not in each[1]]
    hands = fed(FLEET, sent).hand_positions()
    assert np.isnan(hands[:, 1]).all()
    assert np.isfinite(hands[:, [0, 2]]).all()


def test_fleet_time_starts_at_the_epoch_of_the_newest_mission() -> None:
    def mission(version: int, epoch_s: int, duration_s: int) -> Sent:
        epoch_ns = EPOCH_NS + epoch_s * 10**9
        return (
            EPOCH_NS,
            key_expressions.mission(NAME),
            Mission(version, EPOCH_NS, epoch_ns, duration_s * 10**9, ""),
        )

    pose = PlantState(1, 0, EPOCH_NS + 30 * 10**9, *(0.0,) * 7, True, True, True, "")
    recording = fed(
        FLEET,
        [
            mission(1, 5, 9),
            mission(3, 20, 7),
            mission(2, 8, 8),
            (pose.time_ns, key_expressions.plant_state(NAME, 1), pose),
        ],
    )
    assert recording.robots[1].plant.t.tolist() == [10.0]
    assert (recording.planned_s, recording.end_s) == (7.0, 7.0)


def test_the_drive_ends_as_planned_or_when_stopped_or_with_the_data() -> None:
    sent = list(messages(FLEET, in_formation(FLEET)))
    assert fed(FLEET, sent).end_s == 1.6
    stop = (EPOCH_NS + 500_000_000, key_expressions.stop(NAME), Stop(1, EPOCH_NS + 500_000_000, "enough"))
    assert fed(FLEET, [*sent, stop]).end_s == 0.5
    late = (
        EPOCH_NS + 1_700_000_000,
        key_expressions.stop(NAME),
        Stop(1, EPOCH_NS + 1_700_000_000, "the end"),
    )
    assert fed(FLEET, [*sent, late]).end_s == 1.6
    assert fed(FLEET, (each for each in sent if each[0] < EPOCH_NS + 10**9)).end_s == pytest.approx(0.98)
    assert fed(FLEET, []).end_s == 0.0
    assert fed(FLEET, []).grid.tolist() == [0.0]


def test_a_stop_lasts_until_leave_of_a_greater_version_for_that_robot() -> None:
    sent = list(messages(FLEET, in_formation(FLEET)))

    def stop(t: float, version: int) -> Sent:
        return (
            EPOCH_NS + round(t * 1e9),
            key_expressions.stop(NAME),
            Stop(version, EPOCH_NS + round(t * 1e9), ""),
        )

    def resume(t: float, version: int, *robots: int) -> Sent:
        stamp = EPOCH_NS + round(t * 1e9)
        return (stamp, key_expressions.resume(NAME), Resume(version, stamp, robots))

    def halts(*orders: Sent) -> tuple[float, dict[int, list[tuple[float, float]]]]:
        recording = fed(FLEET, [*sent, *orders])
        return recording.end_s, {robot: recording.halts(robot) for robot in (1, 2)}

    assert halts() == (1.6, {1: [], 2: []})
    assert halts(stop(0.5, 7)) == (0.5, {1: [(0.5, inf)], 2: [(0.5, inf)]})
    assert halts(stop(0.5, 7), resume(0.8, 8)) == (1.6, {1: [(0.5, 0.8)], 2: [(0.5, 0.8)]})
    assert halts(stop(0.5, 7), resume(0.8, 7)) == halts(stop(0.5, 7), resume(0.2, 6)) == halts(stop(0.5, 7))
    assert halts(resume(0.2, 8), stop(0.5, 7)) == halts()
    assert halts(stop(0.5, 7), resume(0.8, 8, 2)) == (1.6, {1: [(0.5, inf)], 2: [(0.5, 0.8)]})
    again = halts(stop(0.5, 7), resume(0.8, 8), stop(1.0, 9), stop(1.2, 10))
    assert again == (1.0, {robot: [(0.5, 0.8), (1.0, inf)] for robot in (1, 2)})


def test_late_and_repeated_messages_are_put_in_order() -> None:
    sent = list(messages(FLEET, in_formation(FLEET, 0.5)))
    shuffled = sent + [each for each in sent if "plant/state" in each[1]]
    random.Random(5).shuffle(shuffled)
    assert np.array_equal(fed(FLEET, sent).hand_positions(), fed(FLEET, shuffled).hand_positions())


@pytest.mark.parametrize(
    ("key", "robot", "late_s"),
    [
        (key_expressions.plant_state(NAME, 1), 2, 0),  # another robot's number
        (key_expressions.plant_state(NAME, 9), 9, 0),  # no robot of the fleet
        (key_expressions.hand(NAME, 1), 1, 0),  # another topic's key
        ("other/robot/1/plant/state", 1, 0),  # another fleet
        (key_expressions.mission(NAME), 1, 0),
        (key_expressions.plant_state(NAME, 1), 1, 3600),  # nobody's clock is an hour off
        (key_expressions.plant_state(NAME, 1), 1, -3600),
    ],
)
def test_valid_messages_from_nowhere_change_nothing(key: str, robot: int, late_s: int) -> None:
    sent = list(messages(FLEET, in_formation(FLEET)))
    received_ns = EPOCH_NS + 400_000_000
    time_ns = received_ns - late_s * 10**9
    stray = PlantState(robot, 0, time_ns, 99.0, 99.0, *(0.0,) * 5, True, True, True, "")
    recording = fed(FLEET, [*sent[:300], (received_ns, key, stray), *sent[300:]])
    assert recording.foreign == 1
    assert_same(recording, fed(FLEET, sent))


def test_what_bodies_say_and_who_may_drive_again_is_kept_and_changes_nothing(tmp_path: Path) -> None:
    sent = list(messages(FLEET, in_formation(FLEET)))
    now = EPOCH_NS + 400_000_000
    said: list[Sent] = [
        (
            now,
            key_expressions.checks(NAME, 2),
            Checks(2, 0, now, (("mode", "blocking", "MANUAL", "set GUIDED"),)),
        ),
        (now, key_expressions.resume(NAME), Resume(1, now, (2,))),
    ]
    recording = read_run(write_run(tmp_path / "run", FLEET, [*sent[:300], *said, *sent[300:]]))
    assert recording.foreign == 0
    assert_same(recording, fed(FLEET, sent))
    astray: list[Sent] = [
        (now, key, message) for (_, key, _), (*_, message) in zip(said, said[::-1], strict=True)
    ]
    assert fed(FLEET, [*sent, *astray]).foreign == 2


def test_a_recording_of_version_2_is_read_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its plant states do not say whether a body obeys."""
    sent = list(messages(FLEET, in_formation(FLEET)))
    monkeypatch.setattr(
        "handfast.agent.recorder.message_file.to_json", lambda m: to_json(m).replace(b'"obeying":true,', b"")
    )
    folder = write_run(tmp_path / "run", FLEET, sent)
    assert_same(read_run(folder), fed(FLEET, sent))


def test_what_the_operator_knew_comes_back(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", FLEET, mode="simulate", seed=11) as recorder:
        for received_ns, key, message in messages(FLEET, in_formation(FLEET)):
            recorder.record(received_ns, key, encode(message))
        recorder.set_outcome(["Robot 2's plant died."], interrupted=True)
    back = read_mcap(tmp_path / "run.mcap")
    assert (list(back.reasons), back.interrupted, back.mode, back.seed) == (
        ["Robot 2's plant died."], True, "simulate", 11,
    )  # fmt: skip


def test_a_lone_recording_is_enough(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "run.mcap").write_bytes(whole)
    assert read_run(tmp_path).fleet == FLEET


def rewritten(whole: bytes, change: Callable[[bytes], bytes] = lambda data: data, **options: Any) -> bytes:
    """The same messages written by another program: no chunks, or another compression."""
    out = BytesIO()
    writer = Writer(out, **options)
    writer.start()
    source = make_reader(BytesIO(whole))
    for each in source.iter_metadata():
        writer.add_metadata(each.name, each.metadata)
    for file in source.iter_attachments():
        writer.add_attachment(0, 0, file.name, file.media_type, file.data)
    ids: dict[int, int] = {}
    for described, channel, stored in source.iter_messages():
        if channel.id not in ids:
            kind = (
                writer.register_schema(described.name, described.encoding, described.data) if described else 0
            )
            ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
        writer.add_message(
            ids[channel.id], stored.log_time, change(stored.data), stored.publish_time, stored.sequence
        )
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize(
    "options",
    [{"use_chunking": False}, {"compression": CompressionType.LZ4}, {"compression": CompressionType.NONE}],
)
def test_other_programs_ways_of_writing_are_read(
    tmp_path: Path, whole: bytes, options: dict[str, Any]
) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    (tmp_path / "b.mcap").write_bytes(rewritten(whole, **options))
    assert_same(read_mcap(tmp_path / "a.mcap"), read_mcap(tmp_path / "b.mcap"))


def without_transitions(data: bytes) -> bytes:
    return data.replace(b'"transition":"epoch"', b'"transition":""')


def as_version_1(data: bytes) -> bytes:
    """A message's JSON without what version 1 of the messages had not."""
    content = json.loads(without_transitions(data))
    for name in ("heard", "degree", "obeying", "transition", "order_version"):
        content.pop(name, None)
    defaults = Mission._field_defaults if "duration_ns" in content else Status._field_defaults
    for name in defaults:
        content.pop(name, None)
    for neighbour in content.get("neighbours", ()):
        for name in ("received", "lost", "offset_us", "error_us"):
            del neighbour[name]
    return json.dumps(content).encode()


def test_a_recording_of_version_1_is_read_as_well(tmp_path: Path, whole: bytes) -> None:
    old = rewritten(whole, as_version_1)
    (tmp_path / "new.mcap").write_bytes(rewritten(whole, without_transitions))
    (tmp_path / "old.mcap").write_bytes(old)
    found = {
        name
        for described, _, stored in make_reader(BytesIO(old)).iter_messages()
        if described is not None and described.name in ("handfast.HandState", "handfast.Status")
        for name in json.loads(stored.data)
    }
    assert {"multipliers", "neighbours"} <= found
    assert not {"heard", "degree", "transition", "order_version"} & found
    assert_same(read_mcap(tmp_path / "old.mcap"), read_mcap(tmp_path / "new.mcap"))


# --- files that are cut, damaged or foreign --------------------------------------------------


def attempt(path: Path) -> tuple[Recording | None, str]:
    """The recording, or why it is refused; any other exception fails the test."""
    try:
        return read_mcap(path), ""
    except (RecordingError, FleetError) as error:
        return None, str(error)


def test_a_file_cut_anywhere_is_read_to_its_last_complete_chunk(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    poses = read_mcap(path).robots[1].truth
    cuts = sorted({*range(60), *range(60, len(whole), 997), *range(len(whole) - 40, len(whole))})
    lengths = []
    for cut in cuts:
        path.write_bytes(whole[:cut])
        recording, refusal = attempt(path)
        if recording is None:
            assert refusal.startswith(str(path))
            assert "\n" not in refusal
            lengths.append(-1)
            continue
        (warning,) = recording.warnings
        assert "cut short" in warning
        found = recording.robots[1].truth
        assert np.array_equal(found.values, poses.values[: len(found)])
        lengths.append(len(found))
    assert lengths == sorted(lengths), "a longer file holds no less"
    assert lengths[0] == -1
    assert 0 < lengths[len(lengths) // 2] < len(poses)
    assert lengths[-1] == len(poses), "only the index was missing"


@pytest.mark.slow
def test_damaged_bytes_are_never_a_traceback(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    chance = random.Random(2008)
    outcomes = set()
    for _ in range(150):
        damaged = bytearray(whole)
        for _ in range(chance.choice((1, 1, 20))):
            damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        recording, refusal = attempt(path)
        if recording is None:
            assert str(path) in refusal
        outcomes.add("refused" if recording is None else "cut" if recording.warnings else "read")
    assert "cut" in outcomes


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty; a recording of handfast (MCAP) was expected"),
        (b"\x89PNG\r\n\x1a\n and so on", "is not an MCAP file; a recording of handfast was expected"),
        (MAGIC[:5], "is not an MCAP file; a recording of handfast was expected"),
        (MAGIC, "is cut short before it says what it is; a recording that a run has left was expected"),
    ],
)
def test_what_is_no_recording_is_one_clear_line(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "run.mcap").write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_run(tmp_path)
    assert str(caught.value) == f"{tmp_path / 'run.mcap'} {says}"


def test_a_foreign_mcap_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(RecordingError, match=r"other\.mcap was not written by handfast"):
        read_mcap(path)


def test_a_recording_without_messages_is_refused(tmp_path: Path) -> None:
    Recorder(tmp_path / "run.mcap", FLEET).close()
    with pytest.raises(RecordingError, match=r"run\.mcap holds no message: there is nothing to report$"):
        read_mcap(tmp_path / "run.mcap")


def test_json_that_is_no_message_is_refused(tmp_path: Path, whole: bytes) -> None:
    stored = rewritten(whole, compression=CompressionType.NONE, enable_crcs=False)
    (tmp_path / "run.mcap").write_bytes(stored.replace(b'"yaw_rate":', b'"yaw-rate":'))
    with pytest.raises(RecordingError, match=r"robot/\d/plant/\w+ holds what is not a message of handfast$"):
        read_mcap(tmp_path / "run.mcap")


def test_folders_that_hold_no_run_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError) as caught:
        read_run(tmp_path / "nowhere")
    assert str(caught.value) == (
        f"{tmp_path / 'nowhere'} does not exist; give the folder that a run has left (it holds run.mcap)"
    )
    with pytest.raises(RecordingError) as caught:
        read_run(tmp_path)
    assert str(caught.value) == f"{tmp_path} holds no run.mcap; give the folder that a run has left"
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="is not a folder"):
        read_run(tmp_path / "file")


def test_a_spoilt_fleet_file_beside_it_is_said(tmp_path: Path, whole: bytes) -> None:
    (tmp_path / "run.mcap").write_bytes(whole)
    (tmp_path / "fleet.toml").write_text("[fleet]\nname = 3\n")
    with pytest.raises(FleetError, match=r"fleet\.toml"):
        read_run(tmp_path)


def test_other_hand_offsets_move_the_hand_points() -> None:
    """The fleet file decides, per robot."""
    robots = (replace(FLEET.robots[0], hand_offset_m=0.4), *FLEET.robots[1:])
    fleet = replace(FLEET, robots=robots)
    sent: list[tuple[int, str, Message]] = list(
        messages(fleet, [standing(0, 0), standing(1, 0), standing(2, 0)])
    )
    assert fed(fleet, sent).hand_positions()[0].tolist() == [[0.4, 0.0], [1.1, 0.0], [2.1, 0.0]]
