"""A damaged recording is named as the cause of what it lacks, and no robot is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import encode
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.mcap_records import PREFIX
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages

NEAR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=10.0, rate_hz=50.0)
FAR = make_fleet([(0.0, 0.0), (9.0, 0.0)], [(1, 2)], duration_s=10.0, rate_hz=50.0)


def left(folder: Path, fleet: Fleet, ways: Any = None) -> bytearray:
    """What a run leaves."""
    (folder / "fleet.toml").write_text(tomli_w.dumps(to_dict(fleet)))
    with Recorder(folder / "run.mcap", fleet) as recorder:
        for received_ns, key, message in messages(fleet, ways or in_formation(fleet)):
            recorder.record(received_ns, key, encode(message))
    return bytearray((folder / "run.mcap").read_bytes())


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where each begins, and how long its content is."""
    found, at = [], 8
    while at + PREFIX.size <= len(data):
        opcode, length = PREFIX.unpack_from(data, at)
        if opcode == 6:
            found.append((at, length))
        if opcode == 2:
            break
        at += PREFIX.size + length
    return found


def spoilt(folder: Path, fleet: Fleet, number: int) -> Recording:
    """Of which a byte in a chunk is another one."""
    data = left(folder, fleet)
    begin, length = chunks(data)[number]
    data[begin + length // 2] ^= 0xFF
    (folder / "run.mcap").write_bytes(data)
    return read_run(folder)


def cut(folder: Path, fleet: Fleet, number: int, ways: Any = None) -> Recording:
    """That ends within a chunk."""
    data = left(folder, fleet, ways)
    begin, length = chunks(data)[number]
    (folder / "run.mcap").write_bytes(data[: begin + length // 2])
    return read_run(folder)


def test_what_is_lost_in_mid_drive_is_one_sentence(tmp_path: Path) -> None:
    recording = spoilt(tmp_path, NEAR, 5)
    (lost,) = recording.damage
    assert lost.file == "run.mcap"
    result = RunResult(recording)
    (reason,) = result.reasons
    assert reason.startswith("Robots 1 and 2 sent no pose from ")
    assert " (run.mcap is damaged); it may have come within 0.00 m of robot " in reason
    (warning,) = result.warnings
    assert "damaged from" in warning


def test_what_is_lost_where_nothing_can_have_happened_fails_nothing(tmp_path: Path) -> None:
    result = RunResult(spoilt(tmp_path, FAR, 5))
    assert result.reasons == []
    (warning,) = result.warnings
    assert "damaged from" in warning


def test_a_file_that_ends_in_mid_drive_is_one_sentence(tmp_path: Path) -> None:
    recording = cut(tmp_path, FAR, 5)
    (lost,) = recording.damage
    (reason,) = RunResult(recording).reasons
    assert reason == f"The recording is damaged: run.mcap ends after {lost.start_s:.2f} s of 10.0 s."
    assert recording.end_s == pytest.approx(lost.start_s, abs=0.05)


def test_nothing_is_said_of_the_end_of_a_drive_that_the_file_does_not_have(tmp_path: Path) -> None:
    """Robot 2 is three metres from its place all the time that is recorded."""
    ways = [in_formation(FAR)[0], lambda t: (12.0, 0.0, 0.0)]
    recording = cut(tmp_path, FAR, 5, ways)
    result = RunResult(recording)
    (reason,) = result.reasons
    assert reason.startswith("The recording is damaged: run.mcap ends after ")
    assert not [each for each in result.warnings if "its place" in each]


def test_what_is_lost_after_the_drive_is_not_missed(tmp_path: Path) -> None:
    fleet = make_fleet([(0.0, 0.0), (9.0, 0.0)], [(1, 2)], duration_s=10.0, rate_hz=50.0)
    data = left(tmp_path, fleet)
    begin, length = chunks(data)[-1]
    (tmp_path / "run.mcap").write_bytes(data[: begin + length + PREFIX.size + 40])
    recording = read_run(tmp_path)
    assert recording.damage
    assert RunResult(recording).reasons == []
