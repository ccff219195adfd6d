"""A film shows the drive, is whole or not there, and says what is missing to make it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from handfast.agent.messages.types import PlantState
from handfast.deploy.cli import main
from handfast.deploy.recording.collector import RunData
from handfast.deploy.report.film import FilmError, film
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import FLEET, result_of
from tests.unit.deploy.synthetic_run import in_formation, messages

RESULT = result_of()
needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg (apt install ffmpeg)")


@pytest.fixture
def without_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")


def pictures(path: Path) -> list[np.ndarray]:
    with Image.open(path) as image:
        found = []
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            found.append(np.asarray(image.convert("RGB")).astype(int))
    return found


@pytest.mark.usefixtures("without_ffmpeg")
def test_a_gif_needs_no_ffmpeg(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    out = tmp_path / "new" / "film.gif"
    long_s = film(RESULT, out, fps=4, width_px=240, shown=lambda *each: done.append(each))
    assert long_s == 3.0
    assert done == [(number, 12) for number in range(1, 13)]
    found = pictures(out)
    assert len(found) == 12
    assert found[0].shape == (*found[0].shape[:1], 240, 3)
    assert (np.abs(found[0] - found[-1]).max(axis=2) > 60).sum() > 100  # the robots have moved
    with Image.open(out) as image:
        assert image.info["duration"] == 250
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.usefixtures("without_ffmpeg")
def test_an_mp4_without_ffmpeg_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(FilmError, match=r"film\.mp4: an mp4 needs ffmpeg .*apt install ffmpeg"):
        film(RESULT, tmp_path / "film.mp4", fps=4, width_px=240)
    assert not list(tmp_path.iterdir())


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_ffmpeg_writes_as_many_pictures_as_the_speed_asks_for(tmp_path: Path, kind: str) -> None:
    out = tmp_path / f"film.{kind}"
    assert film(RESULT, out, speed=1.5, fps=4, width_px=240) == 2.0
    subprocess.run(
        ["ffmpeg", "-loglevel", "error", "-i", str(out), str(tmp_path / "%03d.png")], check=True, timeout=60
    )
    found = sorted(tmp_path.glob("*.png"))
    assert len(found) == 8
    first, last = pictures(found[0])[0], pictures(found[-1])[0]
    assert (np.abs(first - last).max(axis=2) > 60).sum() > 100


def test_an_ffmpeg_that_fails_is_quoted_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    program = programs / "ffmpeg"
    program.write_text("#!/bin/sh\necho 'no such encoder' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    out = tmp_path / "out"
    with pytest.raises(FilmError, match="ffmpeg cannot write the film: no such encoder"):
        film(RESULT, out / "film.mp4", fps=4, width_px=240)
    assert not list(out.iterdir())


@pytest.mark.parametrize("kind", ["mp4", "gif"])
@needs_ffmpeg
def test_what_is_interrupted_leaves_the_film_of_before(tmp_path: Path, kind: str) -> None:
    out = tmp_path / f"film.{kind}"
    out.write_text("the film of before")

    def interrupted(done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film(RESULT, out, fps=4, width_px=240, shown=interrupted)
    assert list(tmp_path.iterdir()) == [out]
    assert out.read_text() == "the film of before"


def test_a_run_in_which_no_robot_was_seen_has_no_film(tmp_path: Path) -> None:
    data = RunData(FLEET)
    for received, key, message in messages(FLEET, in_formation(FLEET)):
        if not isinstance(message, PlantState):
            data.feed(received, key, message)
    with pytest.raises(FilmError, match="no place of any robot"):
        film(RunResult(data.recording()), tmp_path / "film.gif", fps=4, width_px=240)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FilmError, match="cannot write"):
        film(RESULT, tmp_path / "file" / "film.gif", fps=4, width_px=240)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--fps", "3"), "--speed, --fps and --width belong to --format mp4 or gif"),
        (("--format", "gif", "--out", "a.mp4"), "--out a.mp4: the name of this film must end in .gif"),
    ],
)
def test_the_command_refuses_options_that_contradict_the_format(
    options: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "runs", *options]) == 2
    assert capsys.readouterr().err == f"handfast: {says}\n"
