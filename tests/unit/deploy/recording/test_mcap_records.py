"""Of a recording that is damaged anywhere, all is read but the chunks that are, and these are named."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import pytest
import tomli_w
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.writer import CompressionType

from handfast.agent.fleet.loading import to_dict
from handfast.agent.messages.codec import encode
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.mcap_records import MAGIC
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.run_folder import rebuild
from tests.unit.deploy.recording.test_recording import rewritten
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages, triangle

FLEET = make_fleet(*triangle(2), duration_s=5.0, rate_hz=10.0)
PREFIX_BYTES = 9
"""Of a record: its opcode and its length."""
HEAD_BYTES = PREFIX_BYTES + 40 + len("zstd")
"""Of a chunk at most: what stands before its messages."""
Stamps = dict[str, list[int]]
"""By key, the times (ns) that plants, hands and wrenches carry."""


class Place(NamedTuple):
    """One chunk: its bytes from where to where, from when to when its messages came, what they are, and
    whether it says what later ones are."""

    begin: int
    end: int
    since_s: float
    until_s: float
    stamps: Stamps
    introduces: bool


class Run(NamedTuple):
    """A whole file."""

    data: bytes
    chunks: list[Place]
    summary: int
    """Where it begins."""

    def __repr__(self) -> str:
        return f"{len(self.data)} bytes, {len(self.chunks)} chunks"


def read_stamps(chunks: Iterable[Stamps]) -> Stamps:
    out: Stamps = {}
    for stamps in chunks:
        for key, times in stamps.items():
            out.setdefault(key, []).extend(times)
    return {key: sorted(times) for key, times in out.items()}


def run_of(data: bytes) -> Run:
    """What the library itself reads of a file that is sound."""
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    channels = {each.id: each.topic for each in summary.channels.values()}
    chunks = [
        each for each in StreamReader(BytesIO(data), emit_chunks=True).records if isinstance(each, Chunk)
    ]
    places = []
    for index, chunk in zip(summary.chunk_indexes, chunks, strict=True):
        stamps: Stamps = {}
        records = breakup_chunk(chunk, validate_crc=True)
        for record in records:
            if isinstance(record, Message):
                topic = channels[record.channel_id]
                if re.search(r"/(plant/state|hand|plant/wrench)$", topic):
                    stamps.setdefault(topic, []).append(json.loads(record.data)["time_ns"])
        begin = index.chunk_start_offset
        since_s, until_s = (
            (each - EPOCH_NS) / 1e9 for each in (chunk.message_start_time, chunk.message_end_time)
        )
        introduces = any(isinstance(record, Channel | Schema) for record in records)
        places.append(Place(begin, begin + index.chunk_length, since_s, until_s, stamps, introduces))
    (footer,) = (each for each in StreamReader(BytesIO(data)).records if isinstance(each, Footer))
    return Run(data, places, footer.summary_start)


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("run")
    with Recorder(folder / "run.mcap", FLEET) as recorder:
        for received_ns, key, message in messages(FLEET, in_formation(FLEET)):
            recorder.record(received_ns, key, encode(message))
        recorder.set_outcome(["Robot 2 died."])
    data = (folder / "run.mcap").read_bytes()
    if request.param != "zstd":
        compression = {"lz4": CompressionType.LZ4, "none": CompressionType.NONE}[request.param]
        data = rewritten(data, compression=compression, chunk_size=20_000)
    found = run_of(data)
    assert len(found.chunks) > 4
    return found


def stamps_of(recording: Recording) -> Stamps:
    prefix = FLEET.fleet.name
    return {
        f"{prefix}/robot/{robot}/{key}": sorted(map(int, table.stamps_ns))
        for robot, data in recording.robots.items()
        for key, table in (("plant/state", data.plant), ("hand", data.hand), ("plant/wrench", data.wrench))
        if len(table)
    }


def written(folder: Path, data: bytes) -> Path:
    (folder / "fleet.toml").write_text(tomli_w.dumps(to_dict(FLEET)))
    (folder / "run.mcap").write_bytes(data)
    return folder


def read(folder: Path, data: bytes) -> tuple[Stamps, list[str]]:
    """What is read, and what is said; nothing of what is refused."""
    try:
        recording = read_run(written(folder, data))
    except RecordingError as error:
        return {}, str(error).splitlines()
    return stamps_of(recording), list(recording.warnings)


def is_the_same(damaged: bytes, data: bytes, place: Place) -> bool:
    """Whether a chunk that was changed in what is packed unpacks to the same: a match elsewhere may be as
    good."""
    was, now = data[place.begin : place.end], damaged[place.begin : place.end]
    head = len(was) - len(Chunk.read(ReadDataStream(BytesIO(was[PREFIX_BYTES:]))).data)
    if len(damaged) != len(data) or now[:head] != was[:head]:
        return False
    was, now = was[PREFIX_BYTES:], now[PREFIX_BYTES:]
    try:
        return unpacked(now) == unpacked(was)
    except Exception:  # a dozen of the decompressors'
        return False


def unpacked(content: bytes) -> bytes:
    """By the library, which checks the sum."""
    stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(content))), validate_crc=True)
    return bytes(stream.read(length))


def spoilt(data: bytes, begin: int, length: int, how: str) -> bytes:
    part = data[begin : begin + length]
    new = bytes(length) if how == "zero" else bytes(each ^ 0x55 for each in part) if how == "other" else b""
    return data[:begin] + new[: len(part)] + data[begin + length :]


DAMAGE = given(
    where=st.floats(0.0, 1.0, exclude_max=True),
    length=st.sampled_from([1, 1, 9, 100, 4096, 30_000]),
    how=st.sampled_from(["zero", "other", "missing"]),
    killed=st.booleans(),
)
SETTINGS = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.slow
@SETTINGS
@DAMAGE
@example(where=0.0, length=1, how="other", killed=False)
@example(where=0.0625, length=1, how="zero", killed=False)  # a schema of what later chunks introduce
@example(where=0.0, length=4096, how="zero", killed=False)
@example(where=0.0, length=4096, how="zero", killed=True)
@example(where=0.06675, length=1, how="missing", killed=True)  # of an index before a chunk
@example(where=0.8098648945239489, length=1, how="zero", killed=True)  # LZ4 unpacks it to the same bytes
@example(where=0.581389577888626, length=1, how="other", killed=True)  # of how long is what is packed
@example(where=0.9160610250696725, length=1, how="other", killed=True)  # of how long the last is
@example(where=0.12, length=4096, how="zero", killed=False)  # two, of which LZ4 unpacks one to the same bytes
def test_all_is_read_but_the_chunks_that_are_damaged(
    run: Run, tmp_path: Path, where: float, length: int, how: str, killed: bool
) -> None:
    """Whatever is zeroed, changed or missing, wherever it is, also of a file that has no end."""
    data = run.data
    if killed:
        data = data[: run.chunks[-1].end]
    begin = int(where * len(data))
    length = min(length, len(data) - begin)
    sound = [each for each in run.chunks if each.end <= begin or begin + length <= each.begin]
    hit = [each for each in run.chunks if each not in sound]
    damaged = spoilt(data, begin, length, how)
    found, said = read(tmp_path, damaged)
    hit = [each for each in hit if not is_the_same(damaged, data, each)]
    sound = [each for each in run.chunks if each not in hit]
    has_summary = not killed and begin + length <= run.summary and how != "missing"
    if not has_summary and any(each.introduces for each in hit):
        return  # what the others are was said there alone
    if any(each.begin <= begin and begin + length <= each.begin + HEAD_BYTES for each in hit):
        # What a chunk says of itself before its messages, which may be there all the same.
        assert found in (read_stamps(each.stamps for each in those) for those in (sound, run.chunks))
        return
    assert found == read_stamps(each.stamps for each in sound)
    text = " ".join(said)
    assert bool(hit) <= ("damaged" in text)
    assert len(said) <= 3
    if has_summary and run.chunks[0] not in hit:  # else its epoch is lost
        for each in hit:
            since, until = f"{each.since_s:.1f} s", f"{each.until_s:.1f} s"
            assert (f"from {since} to {until}" if since != until else f"at {since}") in text


def test_a_flipped_byte_costs_its_chunk_and_nothing_else(run: Run, tmp_path: Path) -> None:
    place = run.chunks[-2]
    middle = (place.begin + place.end) // 2
    for data in (run.data, run.data[: run.chunks[-1].end]):
        found, said = read(tmp_path, spoilt(data, middle, 1, "other"))
        assert found == read_stamps(each.stamps for each in run.chunks if each is not place)
        path = tmp_path / "run.mcap"
        expected = f"{path}: damaged from {place.since_s:.1f} s to {place.until_s:.1f} s, left out"
        cut = f"{path} is cut short or damaged: what follows its last complete chunk is lost"
        assert [each for each in said if "Robot 2" not in each] == (
            [expected] if data is run.data else [expected, cut]
        )


@pytest.mark.parametrize("at", range(9))
def test_a_length_or_opcode_that_is_damaged_hides_no_other_chunk(run: Run, tmp_path: Path, at: int) -> None:
    """One of a chunk, and of what lies between two chunks: it may say that it goes on over the next ones."""
    hit = run.chunks[-3]
    for begin in (hit.begin, hit.end):
        for bit in range(8):
            data = bytearray(run.data)
            data[begin + at] ^= 1 << bit
            found, said = read(tmp_path, bytes(data))
            sound = [each.stamps for each in run.chunks if each is not hit or at == 0 or begin == hit.end]
            assert found == read_stamps(sound)
            assert len(said) == 1 or at == 0


def test_a_record_that_claims_the_whole_next_chunk_does_not_get_it(run: Run, tmp_path: Path) -> None:
    begin, end = run.chunks[-3].end, run.chunks[-2].end
    assert run.data[begin] == Opcode.MESSAGE_INDEX
    claims = run.data[: begin + 1] + (end - begin - 9).to_bytes(8, "little") + run.data[begin + 9 :]
    found, said = read(tmp_path, claims)
    assert found == read_stamps(each.stamps for each in run.chunks)
    assert said == [f"{tmp_path / 'run.mcap'} is cut short or damaged: its messages are all there"]


def test_times_of_a_chunk_that_are_damaged_too_are_those_of_its_neighbours(run: Run, tmp_path: Path) -> None:
    before, hit, after = run.chunks[-3:]
    data = spoilt(run.data[: after.end], hit.begin + 9, 16, "zero")
    _, said = read(tmp_path, spoilt(data, hit.end - 9, 1, "other"))
    assert f"damaged from {before.until_s:.1f} s to {after.since_s:.1f} s, left out" in said[0]


def test_what_the_channels_are_is_found_at_the_end(run: Run, tmp_path: Path) -> None:
    found, (said,) = read(tmp_path, spoilt(run.data, run.chunks[0].end - 5, 1, "other"))
    assert found == read_stamps(each.stamps for each in run.chunks[1:])
    assert "damaged from" in said


def test_a_file_that_has_lost_its_end_too_says_what_it_cannot_tell(run: Run, tmp_path: Path) -> None:
    data = spoilt(run.data[: run.chunks[-1].end], run.chunks[0].end - 5, 1, "other")
    _, said = read(tmp_path, data)
    if run.chunks[1].introduces:
        assert "messages of later on are lost as well" in said[1]
    else:
        assert said[0].endswith(
            "run.mcap holds no message (it is cut short or damaged): there is nothing to report"
        )


def test_its_beginning_may_be_lost(run: Run, tmp_path: Path) -> None:
    found, said = read(tmp_path, bytes(run.chunks[0].begin) + run.data[run.chunks[0].begin :])
    assert found == read_stamps(each.stamps for each in run.chunks)
    name = tmp_path / "run.mcap"
    assert said == [
        f"{name}: what it is a recording of is damaged, left out",
        f"{name} is cut short or damaged: its messages are all there",
    ]
    assert len(MAGIC) < run.chunks[0].begin


def test_a_report_is_made_of_what_is_left(run: Run, tmp_path: Path) -> None:
    place = run.chunks[2]
    folder = written(tmp_path, spoilt(run.data, place.begin + 40, 200, "zero"))
    result = rebuild(folder)
    assert (folder / "report.html").exists()
    assert any("damaged from" in warning for warning in result.warnings)
