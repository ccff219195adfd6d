"""Figures in the formats that are asked for, of what there is something to see of."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from handfast.agent.messages import key_expressions
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import figures, report
from handfast.deploy.report.figures import remove_figures, write_figures
from handfast.deploy.report.plotting import new_figure
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import result_of
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages

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


@pytest.mark.slow
def test_text_in_an_svg_is_text(drawn: Path) -> None:
    words = texts_in_svg(drawn / "distances.svg")
    assert {"1–2", "1–3", "2–3", "safe distance", "fleet time (s)"} <= words
    assert {"1", "2", "3", "end, heading", "x, east (m)"} <= texts_in_svg(drawn / "trajectories.svg")


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
