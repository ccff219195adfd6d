"""A run as a bag of ROS 2: the folder that is written, read back, replaced and left alone."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

from handfast.agent.common.errors import MissingPackageError
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, PlantState
from handfast.deploy import cli
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import rosbag2
from handfast.deploy.report.export import export
from tests.unit.deploy.simulated_run import driven, leave_run, trio
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, in_formation, make_fleet, messages, triangle

FLEET = make_fleet(*triangle(2), duration_s=0.4)


def leave(folder: Path, sent: list[Sent]) -> Path:
    folder.mkdir(exist_ok=True)
    with Recorder(folder / "run.mcap", FLEET) as recorder:
        for received_ns, key, message in sent:
            recorder.record(received_ns, key, encode(message))
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return leave(tmp_path / "run", list(messages(FLEET, in_formation(FLEET))))


def read(bag: Path) -> list[tuple[str, int, Any]]:
    """Topic, time and message of all that a bag holds, in its order."""
    with AnyReader([bag]) as reader:
        return [
            (connection.topic, time_ns, reader.deserialize(raw, connection.msgtype))
            for connection, time_ns, raw in reader.messages()
        ]


def content(folder: Path) -> dict[str, bytes]:
    """Every file in a folder, hidden ones too, by its path there."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_bag_is_a_folder_that_is_read_back(run: Path) -> None:
    (bag,) = export(run, "rosbag2")
    assert bag == run / "export" / "rosbag2"
    assert set(content(run / "export")) == {"rosbag2/metadata.yaml", "rosbag2/rosbag2.mcap"}
    found = read(bag)
    counts = Counter(topic for topic, _, _ in found)
    recording = read_run(run)
    poses = len(recording.robots[1].plant)
    assert counts["/robot_1/pose"] == counts["/robot_3/odom"] == poses == 40
    assert counts["/tf"] == 3 * poses
    assert counts["/tf_static"] == counts["/robot_2/path"] == 1
    assert counts["/robot_1/wanted"] == counts["/min_distance"] == counts["/edge_2_3/error"] == 21
    assert counts["/edges"] == 5
    times = [time_ns for _, time_ns, _ in found]
    assert times == sorted(times)
    assert times[0] == EPOCH_NS - 200_000_000
    stamped = [(time_ns, each.header.stamp) for topic, time_ns, each in found if topic == "/robot_2/pose"]
    assert [time_ns for time_ns, _ in stamped] == recording.robots[2].plant.stamps_ns.tolist()
    assert all(time_ns == stamp.sec * 10**9 + stamp.nanosec for time_ns, stamp in stamped)


def test_messages_lie_in_the_file_in_the_order_of_time(run: Path) -> None:
    """What plays a bag as it lies there, as through a pipe, goes forward."""
    from mcap.reader import NonSeekingReader

    (bag,) = export(run, "rosbag2")
    with open(bag / "rosbag2.mcap", "rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        found = [
            (channel.topic, message.log_time)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
    assert found[0][0] == "/tf_static"
    assert [time_ns for _, time_ns in found] == sorted(time_ns for _, time_ns in found)


@pytest.mark.slow
def test_its_metadata_are_such_as_humble_reads(run: Path) -> None:
    (bag,) = export(run, "rosbag2")
    about = YAML(typ="safe").load(bag / "metadata.yaml")["rosbag2_bagfile_information"]
    assert about["version"] == 8
    assert (about["storage_identifier"], about["relative_file_paths"]) == ("mcap", ["rosbag2.mcap"])
    assert about["starting_time"] == {"nanoseconds_since_epoch": EPOCH_NS - 200_000_000}
    assert about["message_count"] == len(read(bag))
    # Humble takes the profiles as one text, and in it numbers for the names of policies.
    profiles = {
        each["topic_metadata"]["name"]: each["topic_metadata"]["offered_qos_profiles"]
        for each in about["topics_with_message_count"]
    }
    (tf,) = YAML(typ="safe").load(profiles["/tf"])
    assert (tf["history"], tf["depth"], tf["reliability"], tf["durability"]) == (1, 100, 1, 2)
    assert (
        about["custom_data"].items() >= {"fleet": "made-up", "epoch_ns": str(EPOCH_NS), "mode": "run"}.items()
    )


def test_quality_of_service(run: Path) -> None:
    (bag,) = export(run, "rosbag2")
    durabilities = {}
    with Reader(bag) as reader:
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            (profile,) = connection.ext.offered_qos_profiles
            assert profile.history == QosHistory.KEEP_LAST
            assert profile.reliability == QosReliability.RELIABLE
            durabilities[connection.topic] = profile.durability
            if connection.topic == "/tf_static":
                assert profile.depth == 1
            if connection.topic == "/rosout":
                assert profile.lifespan == (10, 0)
    latched = {topic for topic, each in durabilities.items() if each == QosDurability.TRANSIENT_LOCAL}
    assert latched == {"/tf_static", "/rosout", "/robot_1/path", "/robot_2/path", "/robot_3/path"}


@pytest.mark.slow
def test_a_simulated_run(tmp_path: Path) -> None:
    fleet = trio(duration=1.0)
    folder = leave_run(tmp_path / "run", fleet, driven(fleet))
    (bag,) = export(folder, "rosbag2", tmp_path / "out")
    assert bag == tmp_path / "out" / "rosbag2"
    found = read(bag)
    recording = read_run(folder)
    assert found[0][1] == min(robot.plant.stamps_ns[0] for robot in recording.robots.values())
    at_epoch = [topic for topic, time_ns, _ in found if time_ns == recording.epoch_ns]
    assert {"/robot_1/pose", "/robot_3/wanted", "/edge_1_2/error"} <= set(at_epoch)


@pytest.mark.slow
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("No space left on device")])
@pytest.mark.parametrize("begun", [0, 50])
def test_an_export_that_fails_leaves_the_earlier_one(
    run: Path, monkeypatch: pytest.MonkeyPatch, error: Any, begun: int
) -> None:
    export(run, "rosbag2")
    before = content(run / "export")
    write, count = rosbag2.Writer.write, 0

    def failing(*args: Any) -> None:
        nonlocal count
        count += 1
        if count > begun:
            raise error
        write(*args)

    monkeypatch.setattr(rosbag2.Writer, "write", failing)
    expected = RecordingError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        export(run, "rosbag2")
    assert content(run / "export") == before
    assert [each.name for each in (run / "export").iterdir()] == ["rosbag2"]
    with pytest.raises(expected):
        export(run, "rosbag2", run / "other")
    assert not list((run / "other").iterdir())


def test_what_is_not_a_bag_of_ours_is_not_replaced(run: Path, tmp_path: Path) -> None:
    bag = tmp_path / "out" / "rosbag2"
    bag.mkdir(parents=True)
    (bag / "notes.txt").write_text("mine")
    with pytest.raises(
        RecordingError, match=r"out/rosbag2 is not a bag of handfast alone: name another folder"
    ):
        export(run, "rosbag2", tmp_path / "out")
    assert content(tmp_path / "out") == {"rosbag2/notes.txt": b"mine"}
    elsewhere = tmp_path / "link"
    elsewhere.mkdir()
    (elsewhere / "rosbag2").symlink_to(export(run, "rosbag2")[0])
    with pytest.raises(RecordingError, match="is not a bag of handfast alone"):
        export(run, "rosbag2", elsewhere)
    (run / "file").touch()
    with pytest.raises(RecordingError, match=rf"^cannot write the export to {run / 'file'}: "):
        export(run, "rosbag2", run / "file")


def refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What the command says to a run of which there is no bag; it leaves nothing."""
    assert cli.main(["export", str(folder), "--format", "rosbag2"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert not (folder / "export").exists()
    (line,) = said.err.splitlines()
    return line


def test_a_run_without_a_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sent = [each for each in messages(FLEET, in_formation(FLEET)) if not isinstance(each[2], PlantState)]
    assert "it has no pose of any robot" in refused(leave(tmp_path, sent), capsys)


def test_times_that_ros_cannot_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late_ns = 2**31 * 10**9 - EPOCH_NS - 200_000_000
    sent: list[Sent] = [
        (received_ns + late_ns, key, message._replace(time_ns=message.time_ns + late_ns))
        for received_ns, key, message in messages(FLEET, in_formation(FLEET))
    ]
    sent = [
        (time, key, each._replace(epoch_ns=each.epoch_ns + late_ns) if isinstance(each, Mission) else each)
        for time, key, each in sent
    ]
    assert "no times before 1970 or after 2038" in refused(leave(tmp_path, sent), capsys)


def test_without_rosbags_it_says_what_to_install(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rosbag2", "ros_messages"):
        monkeypatch.delitem(sys.modules, f"handfast.deploy.report.{name}")
        monkeypatch.delattr(f"handfast.deploy.report.{name}")
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    expected = r"^--format rosbag2 needs the package rosbags\S*: pip install 'handfast\[ros2\]'$"
    with pytest.raises(MissingPackageError, match=expected):
        export(run, "rosbag2")
    assert not (run / "export").exists()
