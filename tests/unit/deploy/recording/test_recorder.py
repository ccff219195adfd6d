"""Recordings as other programs see them: through the `mcap` library's own reader, and as bytes."""

from __future__ import annotations

import json
import resource
import signal
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import (
    CLASSES,
    CORRUPTED,
    REORDERED,
    TOPICS,
    Checks,
    HandState,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Wrench,
)
from handfast.agent.recorder.message_file import CHANNELS_MAX, RUN_METADATA
from handfast.agent.recorder.message_json import reader, schema, to_json
from handfast.deploy.recording.foxglove.channels import Channels
from handfast.deploy.recording.foxglove.schemas import SCHEMAS
from handfast.deploy.recording.mcap_reader import read_mcap
from handfast.deploy.recording.mcap_records import MAGIC
from handfast.deploy.recording.recorder import FLUSH_PERIOD_NS, OUTCOME_METADATA, Recorder
from handfast.deploy.recording.run_files import FLEET_FILE, RecordingError
from tests.declared_messages import messages_of
from tests.unit.deploy.synthetic_run import (
    EPOCH_NS,
    in_formation,
    make_fleet,
    messages,
    payloads,
    triangle,
)

FLEET = make_fleet(*triangle(2), duration_s=1.0)

any_message = st.one_of(*map(messages_of, CLASSES))


def record(path: Path, sent: Any, **options: Any) -> Recorder:
    with Recorder(path, FLEET, **options) as recorder:
        for each in sent:
            recorder.record(*each)
    return recorder


def read(path: Path) -> list[tuple[Any, Any, Any]]:
    return list(make_reader(BytesIO(path.read_bytes())).iter_messages(log_time_order=False))


def conforms(value: Any, described: dict[str, Any]) -> bool:
    """Whether `value` is as its JSON schema says: the few words of it that we use."""
    kind = described["type"]
    if kind == "object":
        inside = described["properties"]
        return set(value) == set(inside) and all(conforms(value[name], inside[name]) for name in inside)
    if kind == "array":
        return all(conforms(item, described["items"]) for item in value)
    if kind in ("integer", "boolean", "string"):
        return type(value) is {"integer": int, "boolean": bool, "string": str}[kind]
    return kind == "number" and type(value) is float


@given(any_message)
def test_json_holds_all_of_a_message_and_is_what_its_schema_says(message: Message) -> None:
    content = json.loads(to_json(message))
    assert list(content) == list(message._fields)
    assert conforms(content, schema(type(message)))
    assert reader(type(message))(content) == message


def test_a_link_trace_reads_like_text() -> None:
    entries = tuple((2, topic, 7, EPOCH_NS, CORRUPTED | REORDERED, 80_000) for topic in range(len(TOPICS)))
    content = json.loads(to_json(LinkTrace(1, 5, EPOCH_NS, entries)))
    assert [entry["topic"] for entry in content["entries"]] == ["hand", "state", "wrench", "beacon"]
    assert content["entries"][1] == {
        "source": 2, "topic": "state", "sequence": 7, "time_ns": EPOCH_NS, "what": 12, "delay_us": 80_000
    }  # fmt: skip
    content["entries"][0]["topic"] = "hands"
    with pytest.raises(ValueError, match="not in tuple"):
        reader(LinkTrace)(content)


def test_checks_and_leave_to_resume_read_like_text() -> None:
    line = ("mode", "blocking", "MANUAL", "set GUIDED")
    assert json.loads(to_json(Checks(3, 5, EPOCH_NS, (line,)))) == {
        "robot": 3, "sequence": 5, "time_ns": EPOCH_NS,
        "lines": [{"name": "mode", "level": "blocking", "found": "MANUAL", "advice": "set GUIDED"}],
    }  # fmt: skip
    assert to_json(Resume(2, 9, (3, 1))) == b'{"version":2,"time_ns":9,"robots":[3,1]}'
    assert to_json(Resume(2, 9, ())) == b'{"version":2,"time_ns":9,"robots":[]}'


OF_EARLIER_VERSIONS = {
    HandState: (
        {"robot": 1, "sequence": 5, "time_ns": 9, "following": True, "x": 1.0, "y": 2.0, "vx": 0.0, "vy": 0.0,
         "navigation_x": 0.0, "navigation_y": 0.0, "constraint_x": 0.0, "constraint_y": 0.5,
         "multipliers": [{"neighbour": 2, "value": 1.5}]},
        HandState(1, 5, 9, True, 1, 1.0, 2.0, *[0.0] * 5, 0.5, *[0.0] * 3, ((2, 1.5),), ()),
    ),
    Status: (
        {"robot": 1, "sequence": 5, "time_ns": 9, "state": "running", "reason": "", "mission_version": 1,
         "neighbours": [{"robot": 2, "age_us": 20000}, {"robot": 3, "age_us": -1}], "tick_us": [90],
         "ages_us": [], "counters": [{"name": "sent", "value": 3}]},
        Status(1, 5, 9, "running", "", "", 1, 0, ((2, 20_000, 0, 0, 0, -1), (3, -1, 0, 0, 0, -1)), (90,), (),
               (("sent", 3),)),
    ),
    Mission: (  # to version 3
        {"version": 2, "time_ns": 9, "epoch_ns": 8, "duration_ns": 7, "digest": "abc"},
        Mission(2, 9, 8, 7, "abc"),
    ),
    PlantState: (  # of version 1 and 2
        {"robot": 1, "sequence": 5, "time_ns": 9, "x": 1.0, "y": 2.0, "heading": 0.5, "speed": 0.25,
         "yaw_rate": 0.0, "force": 3.0, "torque": 0.0, "driving": True, "healthy": True, "note": ""},
        PlantState(1, 5, 9, 1.0, 2.0, 0.5, 0.25, 0.0, 3.0, 0.0, True, True, True, ""),
    ),
}  # fmt: skip


@pytest.mark.parametrize("cls", OF_EARLIER_VERSIONS)
def test_a_recording_of_an_earlier_version_is_read_as_well(cls: type[Message]) -> None:
    content, message = OF_EARLIER_VERSIONS[cls]
    read = reader(cls)
    before = json.dumps(content)
    assert read(content) == message
    assert json.dumps(content) == before
    for name in content:  # only what was added later may be missing
        with pytest.raises(KeyError):
            read({field: value for field, value in content.items() if field != name})
    again = json.loads(to_json(message))
    assert read(again) == message


def test_a_row_of_a_message_lacks_only_what_was_added_later() -> None:
    content, _ = OF_EARLIER_VERSIONS[Status]
    for broken in ({"robot": 2}, {"age_us": 2}, {}):
        with pytest.raises(KeyError):
            reader(Status)(content | {"neighbours": [broken]})


@pytest.mark.parametrize("cls", CLASSES)
def test_every_field_is_described(cls: type[Message]) -> None:
    described = schema(cls)
    assert list(described["properties"]) == list(cls._fields)
    for field in described["properties"].values():
        for said in (field, *field.get("items", {}).get("properties", {}).values()):
            assert said["description"]
    assert schema(cls)["title"] == f"handfast.{cls.__name__}"


def test_a_recording_holds_every_message_with_its_times(tmp_path: Path) -> None:
    sent = list(messages(FLEET, in_formation(FLEET)))
    recorder = record(tmp_path / "run.mcap", ((t, key, encode(message)) for t, key, message in sent))
    found = [each for each in read(tmp_path / "run.mcap") if "derived" not in each[1].metadata]
    assert recorder.recorded == len(found) == len(sent)
    for (received_ns, key, message), (described, channel, stored) in zip(sent, found, strict=True):
        assert (channel.topic, channel.message_encoding) == (key, "json")
        assert (described.name, described.encoding) == (f"handfast.{type(message).__name__}", "jsonschema")
        assert stored.log_time == received_ns
        assert stored.publish_time == message.time_ns
        assert stored.sequence == getattr(message, "sequence", getattr(message, "version", None))
        assert stored.data == to_json(message)
        assert conforms(json.loads(stored.data), json.loads(described.data))


def test_a_recording_holds_what_bodies_said_and_who_may_drive_again(tmp_path: Path) -> None:
    prefix, checks = FLEET.fleet.name, Checks(2, 5, EPOCH_NS, (("gps", "ok", "fix", ""),))
    sent = [
        (EPOCH_NS, key_expressions.checks(prefix, 2), checks),
        (EPOCH_NS + 1, key_expressions.resume(prefix), Resume(4, EPOCH_NS, (2,))),
    ]
    recorder = record(tmp_path / "run.mcap", ((t, key, encode(message)) for t, key, message in sent))
    assert not recorder.rejected
    names = {f"handfast.{cls.__name__}": cls for cls in CLASSES}
    found = [
        (stored.log_time, channel.topic, reader(names[described.name])(json.loads(stored.data)))
        for described, channel, stored in read(tmp_path / "run.mcap")
        if "derived" not in channel.metadata
    ]
    assert found == sent


def test_the_same_messages_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        record(tmp_path / name, payloads(messages(FLEET, in_formation(FLEET))))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_file_says_what_it_is_and_holds_the_fleet_file(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", FLEET, mode="simulate", seed=7) as recorder:
        recorder.set_outcome(["Robot 2's agent died."], interrupted=True)
    found = make_reader(BytesIO((tmp_path / "run.mcap").read_bytes()))
    metadata = {each.name: each.metadata for each in found.iter_metadata()}
    run = metadata[RUN_METADATA]
    assert (run["fleet"], run["mode"], run["seed"], run["law"]) == ("made-up", "simulate", "7", "joint")
    assert json.loads(metadata[OUTCOME_METADATA]["reasons"]) == ["Robot 2's agent died."]
    (attachment,) = found.iter_attachments()
    assert attachment.name == FLEET_FILE
    assert parse_fleet(attachment.data.decode(), source="attachment") == FLEET


def test_garbage_is_kept_as_it_came_and_counted(tmp_path: Path) -> None:
    key = key_expressions.hand("made-up", 1)
    sent = [
        (EPOCH_NS, key, b"\xff\x00garbage"),
        (EPOCH_NS + 1, key, b""),
        (EPOCH_NS + 2, "else/where", b"{}"),
    ]
    recorder = record(tmp_path / "run.mcap", sent)
    assert sum(recorder.rejected.values()) == 3
    found = read(tmp_path / "run.mcap")
    assert [(channel.topic, stored.log_time, stored.data) for _, channel, stored in found] == [
        (key, EPOCH_NS, b"\xff\x00garbage"), (key, EPOCH_NS + 1, b""), ("else/where", EPOCH_NS + 2, b"{}"),
    ]  # fmt: skip
    assert all(described is None for described, _, _ in found)
    assert {channel.message_encoding for _, channel, _ in found} == {"application/octet-stream"}


def test_made_up_keys_do_not_grow_the_file_without_bound(tmp_path: Path) -> None:
    sent = ((EPOCH_NS + k, f"made/up/{k}", b"x") for k in range(CHANNELS_MAX + 50))
    recorder = record(tmp_path / "run.mcap", sent)
    assert recorder.rejected["channels"] == 50
    assert len(read(tmp_path / "run.mcap")) == CHANNELS_MAX


def test_sequence_numbers_beyond_32_bits_are_recorded(tmp_path: Path) -> None:
    wrench = Wrench(1, 2**40 + 5, EPOCH_NS, 1.0, 2.0, False)
    record(tmp_path / "run.mcap", [(EPOCH_NS, key_expressions.wrench("made-up", 1), encode(wrench))])
    ((_, _, stored),) = read(tmp_path / "run.mcap")
    assert stored.sequence == 5
    assert json.loads(stored.data)["sequence"] == 2**40 + 5


def test_an_error_within_the_run_leaves_a_complete_file(tmp_path: Path) -> None:
    def crash() -> None:
        with Recorder(tmp_path / "run.mcap", FLEET) as recorder:
            recorder.record(EPOCH_NS, "some/key", b"kept")
            raise KeyError("the run's own error")

    with pytest.raises(KeyError, match="the run's own error"):
        crash()
    assert [stored.data for _, _, stored in read(tmp_path / "run.mcap")] == [b"kept"]


def test_a_killed_recorder_has_lost_a_second_at_most(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, FLEET) as recorder:
        for k in range(40):
            recorder.record(EPOCH_NS + k * 100_000_000, "some/key", b"%d" % k)
        content = path.read_bytes()  # what SIGKILL would leave now
    assert content.startswith(MAGIC)
    assert not content.endswith(MAGIC)
    last = max(int(n) for n in _raw_of(content))
    assert 28 <= last < 40


def _raw_of(content: bytes) -> list[bytes]:
    """Payloads of the complete chunks of a file without an end."""
    from mcap.exceptions import EndOfFile
    from mcap.records import Message as Stored
    from mcap.stream_reader import StreamReader

    found = []
    try:
        for each in StreamReader(BytesIO(content)).records:
            if isinstance(each, Stored):
                found.append(each.data)
    except EndOfFile:
        pass
    return found


def test_a_place_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "run.mcap"
    with pytest.raises(RecordingError) as caught:
        Recorder(path, FLEET)
    assert str(caught.value) == f"cannot write the recording {path}: No such file or directory"


def test_a_file_that_is_removed_is_missed_within_a_second(tmp_path: Path) -> None:
    path = tmp_path / "gone" / "run.mcap"
    path.parent.mkdir()
    with Recorder(path, FLEET) as recorder:
        recorder.record(0, "key", b"")
        path.unlink()
        recorder.record(FLUSH_PERIOD_NS // 2, "key", b"")
        with pytest.raises(
            RecordingError, match=r"^cannot write the recording .*run\.mcap: it has been removed$"
        ):
            recorder.record(FLUSH_PERIOD_NS, "key", b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_clear_line() -> None:
    path = Path("/dev/full")
    with pytest.raises(
        RecordingError, match=r"^cannot write the recording /dev/full: No space left on device$"
    ):
        Recorder(path, FLEET)


def test_a_disk_that_fills_up_is_said_once_and_ends_quietly(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", FLEET)
    recorder.record(EPOCH_NS, "some/key", b"buffered")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (recorder.path.stat().st_size, limits[1]))
    try:
        with pytest.raises(RecordingError, match=r"run\.mcap: File too large"):
            recorder.record(EPOCH_NS + 2 * 10**9, "some/key", b"flushes")
        recorder.record(EPOCH_NS + 4 * 10**9, "some/key", b"ignored")
        recorder.set_outcome(["ignored"])
        recorder.close()
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_recording_holds_what_foxglove_shows_and_no_reader_takes_it_for_a_message(tmp_path: Path) -> None:
    fleet = make_fleet(*triangle(2), duration_s=1.0, velocity=(0.4, 0.1))
    sent = list(messages(fleet, in_formation(fleet)))
    derived = Channels(fleet)
    with Recorder(tmp_path / "run.mcap", fleet) as recorder:
        for received_ns, key, message in sent:
            recorder.record_message(received_ns, key, message)
    expected = [
        (received_ns, *each)
        for received_ns, key, message in sent
        for each in derived.feed(received_ns, key, message)
    ]
    found = []
    for described, channel, stored in read(tmp_path / "run.mcap"):
        if channel.topic.startswith("/"):
            assert (channel.metadata, channel.message_encoding) == ({"derived": "true"}, "json")
            assert json.loads(described.data) == SCHEMAS[described.name]
            found.append((stored.log_time, channel.topic, described.name, stored.data))
    assert found == expected
    assert len({topic for _, topic, _, _ in found}) >= 7
    assert recorder.recorded == len(sent)
    assert read_mcap(tmp_path / "run.mcap").foreign == 0


def test_chunks_are_in_the_order_of_time(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", payloads(messages(FLEET, in_formation(FLEET))))
    summary = make_reader(BytesIO((tmp_path / "run.mcap").read_bytes())).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 2
    assert all(a.message_end_time <= b.message_start_time for a, b in pairwise(summary.chunk_indexes))
