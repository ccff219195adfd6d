"""Figures in the formats that are asked for, of what there is something to see of."""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from handfast.agent.messages import key_expressions
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recorder import RecordingError
from handfast.deploy.report import figures, report, timing_figure
from handfast.deploy.report.drawing.plotting import new_figure
from handfast.deploy.report.figures import remove_figures, write_figures
from handfast.deploy.report.link_figure import _with_gaps
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import FLEET, result_of
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages, triangle

NAMES = {"trajectories", "distances", "forces", "timing"}
BEGINS = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run's figures in all formats."""
    folder = tmp_path_factory.mktemp("drawn")
    assert set(write_figures(folder, result_of(), ["pdf", "png", "svg"])) == NAMES
    return folder


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_each_figure_is_there_in_each_format(drawn: Path) -> None:
    assert files(drawn) == {f"{name}.{kind}" for name in NAMES for kind in BEGINS}
    for path in drawn.iterdir():
        assert path.read_bytes().startswith(BEGINS[path.suffix[1:]])


def texts_in_svg(path: Path) -> set[str]:
    root = ElementTree.fromstring(path.read_bytes())
    texts = (element for element in root.iter() if element.tag.endswith("}text"))
    return {"".join(text.itertext()).strip() for text in texts}


def test_text_in_an_svg_is_text(drawn: Path) -> None:
    words = texts_in_svg(drawn / "distances.svg")
    assert {"1–2", "1–3", "2–3", "safe distance", "fleet time (s)"} <= words
    assert {"1", "2", "3", "end, heading", "x, east (m)"} <= texts_in_svg(drawn / "trajectories.svg")


def test_text_in_a_pdf_is_of_fonts_that_can_be_searched(drawn: Path) -> None:
    for name in NAMES:
        content = (drawn / f"{name}.pdf").read_bytes()
        streams = re.findall(rb"stream\r?\n(.*?)endstream", content, re.DOTALL)
        plain = b"".join(each for each in map(inflated, streams) if each)
        assert b"/FontFile2" in content + plain
        assert b"/Type3" not in content + plain


def inflated(stream: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(stream)
    except zlib.error:
        return b""


def test_the_same_run_gives_the_same_bytes_and_no_date(
    drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "PICTURES", {"distances": figures.PICTURES["distances"]})
    write_figures(tmp_path, result_of(), ["svg", "pdf"])
    for kind in BEGINS:
        assert (tmp_path / f"distances.{kind}").read_bytes() == (drawn / f"distances.{kind}").read_bytes()
    for path in drawn.iterdir():
        content = path.read_bytes()
        assert not re.search(rb"Date>|CreationDate|Matplotlib v|/Producer", content)


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures have nothing on them, for a test of which are written."""
    monkeypatch.setattr(figures, "PICTURES", dict.fromkeys(figures.PICTURES, lambda _: new_figure(1.0, 1.0)))


@pytest.mark.usefixtures("blank")
def test_what_was_drawn_before_is_gone(tmp_path: Path) -> None:
    for name in ("distances.pdf", "links.png", "links.svg", "mine.pdf"):
        (tmp_path / name).touch()
    write_figures(tmp_path, result_of(), ["svg"])
    assert files(tmp_path) == {f"{name}.{kind}" for name in NAMES for kind in ("png", "svg")} | {"mine.pdf"}
    report.remove_report(tmp_path)
    assert files(tmp_path) == {"mine.pdf"}


@pytest.mark.usefixtures("blank")
def test_one_that_cannot_be_written_or_removed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trajectories.pdf").mkdir()
    with pytest.raises(RecordingError, match=r"^cannot write .*trajectories\.pdf: Is a directory$"):
        write_figures(tmp_path, result_of(), ["pdf"])

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(RecordingError, match=r"^cannot remove .*trajectories\.png: Permission denied$"):
        remove_figures(tmp_path)


def test_what_is_empty_is_left_out(tmp_path: Path) -> None:
    """Of one robot there are no distances, of poses alone no forces and no times; the page goes without."""
    alone = make_fleet([(0.0, 0.0)], [], duration_s=1.0, rate_hz=10)
    data = RunData(alone)
    for each in messages(alone, in_formation(alone)):
        if "plant/state" in each[1] or each[1] == key_expressions.mission(alone.fleet.name):
            data.feed(*each)
    page = report.write_report(tmp_path, RunResult(data.recording()))
    assert {path.name for path in tmp_path.glob("*.png")} == {"trajectories.png"}
    text = page.read_text()
    assert text.count("<img ") == 1
    assert "Forces and timing" not in text


def test_panels_of_what_was_not_recorded_are_left_out() -> None:
    forces = figures.figure(result_of(), "forces")
    assert len(forces.axes) == 4
    sent = [each for each in messages(FLEET, in_formation(FLEET)) if "wrench" not in each[1]]
    for mode, rows in (("run", 2), ("simulate", 1)):
        data = RunData(FLEET, mode=mode)
        for each in sent:
            data.feed(*each)
        result = RunResult(data.recording())
        titles = [axes.get_title(loc="left") for axes in figures.figure(result, "forces").axes]
        assert titles == ["Navigation force", "Constraint force"]
        timing = figures.figure(result, "timing")
        assert len(timing.axes) == 2 * rows  # ticks take no virtual time


def test_times_are_those_of_the_drive_alone_in_both_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    times, ages = np.array([-1.0, 0.5, 1.0, 99.0]), np.array([60.0, 20.0, 20.0, 80.0])
    row = timing_figure._Row("Age of states", "ms", "k", times, ages)
    monkeypatch.setattr(timing_figure, "_rows", lambda _: [row])
    over_time, spread = figures.figure(result_of(), "timing").axes
    assert {text.get_text() for text in spread.texts} == {"median 20 ms", "99 % 20 ms"}
    assert max(line.get_ydata().max() for line in over_time.lines) == 20.0  # type: ignore[union-attr]
    monkeypatch.setattr(timing_figure, "_rows", lambda _: [row._replace(times=times + 200.0)])
    for axes in figures.figure(result_of(), "timing").axes:
        assert [text.get_text() for text in axes.texts] == ["nothing was recorded during the drive"]


def test_of_one_moment_median_and_percentile_are_seen() -> None:
    row = timing_figure._Row("Age of states", "ms", "k", np.array([0.1]), np.array([20.0]))
    axes = new_figure(4.0, 3.0).add_subplot()
    timing_figure._draw_over_time(axes, row.times, row.values, 0.3, "k")
    assert all(line.get_marker() != "None" for line in axes.lines)


@pytest.mark.parametrize("rows", [1, 3, 6])
def test_nothing_of_a_path_figure_is_cut_off(rows: int) -> None:
    fleet = make_fleet(*triangle(rows), velocity=(4.0, 0.0), duration_s=3.0, rate_hz=10)
    picture = figures.figure(result_of(fleet), "trajectories")
    picture.canvas.draw()
    (axes,) = picture.axes
    whole = picture.bbox
    for text in (axes.xaxis.label, axes.yaxis.label, *axes.texts, *picture.legends):
        box = text.get_window_extent()
        assert whole.x0 <= box.x0
        assert box.x1 <= whole.x1
        assert whole.y0 <= box.y0
        assert box.y1 <= whole.y1


def test_no_line_is_drawn_over_a_time_when_there_was_no_link() -> None:
    t, values = _with_gaps(np.array([0.0, 0.4, 10.0, 10.4]), np.array([1.0, 2.0, 3.0, 4.0]))
    assert t.tolist() == [0.0, 0.4, 0.4, 10.0, 10.4]
    assert np.isnan(values).tolist() == [False, False, True, False, False]
