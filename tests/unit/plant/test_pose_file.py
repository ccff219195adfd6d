"""A simulated body's place outlives its process."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import parse_fleet
from handfast.plant.backend import Check, Command, PlantBackend, Reading
from handfast.plant.server import PersistentBody, PoseFile, PoseFileError
from handfast.plant.unicycle import from_fleet
from tests.unit.agent.fleet.fleet_texts import SMALL

FLEET = parse_fleet(SMALL, source="here")


def test_a_body_stands_again_where_it_was(tmp_path: Path):
    file = tmp_path / "deep" / "robot-1.pose"
    robot = FLEET.ids[0]
    body = PersistentBody(from_fleet(FLEET, robot), PoseFile(file))
    for k in range(100):
        reading = body.step(k * NS_PER_S // 50, Command(20.0, 0.3))
    again = from_fleet(FLEET, robot, PoseFile(file).place)
    assert again.pose == reading.pose._replace(speed=0.0, yaw_rate=0.0)
    assert again.pose != from_fleet(FLEET, robot).pose


def test_it_outlives_a_process_that_is_killed(tmp_path: Path):
    file = tmp_path / "pose"
    code = (
        "import os, pathlib, signal; from handfast.plant.server import PoseFile; "
        "from handfast.agent.control.hand import Pose; "
        f"s = PoseFile(pathlib.Path({str(file)!r})); s.write(Pose(1.5, -2.0, 0.25, 3.0, 0.0)); "
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3]).returncode == -9
    assert PoseFile(file).place == (1.5, -2.0, 0.25)


@given(cut=st.integers(0, 72), flipped=st.integers(0, 71), writes=st.integers(1, 5))
def test_a_record_that_was_cut_or_damaged_leaves_the_one_before(
    tmp_path_factory: pytest.TempPathFactory, cut: int, flipped: int, writes: int
):
    file = tmp_path_factory.mktemp("standing") / "pose"
    standing = PoseFile(file)
    for k in range(1, writes + 1):
        standing.write(Pose(float(k), 0.0, 0.0, 0.0, 0.0))
    standing.close()
    data = bytearray(file.read_bytes())
    data[flipped] ^= 0x10
    file.write_bytes(data)
    assert PoseFile(file).place in (
        {(float(writes), 0.0, 0.0), (float(writes - 1), 0.0, 0.0)} if writes > 1 else {(1.0, 0.0, 0.0), None}
    )
    file.write_bytes(data[:cut])
    os.truncate(file, cut)
    PoseFile(file)  # and a short one is made whole


def test_a_folder_is_refused_in_one_line(tmp_path: Path):
    with pytest.raises(PoseFileError, match=r"cannot use the pose file .*: Is a directory") as caught:
        PoseFile(tmp_path)
    assert not caught.value.transient


def full(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_told_at_the_start_and_kills_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    PoseFile(tmp_path / "pose").write(Pose(1.0, 2.0, 3.0, 0.0, 0.0))
    assert (tmp_path / "pose").stat().st_blocks > 0, "not a hole that a write would have to fill"
    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(PoseFileError, match="No space left on device") as caught:
        PoseFile(tmp_path / "new")
    assert caught.value.transient


def test_what_is_asked_of_the_body_reaches_it(tmp_path: Path):
    class Body(PlantBackend):
        told = 0

        def step(self, now_ns: int, command: Command | None) -> Reading:
            raise NotImplementedError

        def close(self) -> None: ...

        def clear_to_drive(self) -> None:
            self.told += 1

        def checks(self, now_ns: int) -> Sequence[Check]:
            return (Check("battery", "good", f"at {now_ns}"),)

    body = Body()
    standing = PersistentBody(body, PoseFile(tmp_path / "pose"))
    standing.clear_to_drive()
    assert body.told == 1
    assert standing.checks(7) == (Check("battery", "good", "at 7"),)
