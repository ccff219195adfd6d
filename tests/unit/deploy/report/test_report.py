"""Reports: complete, self-contained, safe, and the same bytes however they are made."""

from __future__ import annotations

import base64
import json
import re
import shutil
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import TrajectorySection
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Beacon, Mission, Silent, Status
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import figures, trajectory_figure
from handfast.deploy.report.report import write_report
from handfast.deploy.report.run_folder import rebuild, write_result
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

FLEET = make_fleet(*triangle(3), velocity=(0.5, 0.3), duration_s=3.0, rate_hz=20)
NAMES = ("trajectories", "distances", "forces", "timing")
FILES = ("metrics.json", "report.html", *(f"{name}.png" for name in NAMES))
VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Checks that every element is closed; collects attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def recorded(fleet: Fleet, sent: Iterable[Sent], mode: str = "run") -> Recording:
    data = RunData(fleet, mode=mode)
    for each in sent:
        data.feed(*each)
    return data.recording()


def leave_run(
    folder: Path, fleet: Fleet, sent: Iterable[Sent], *, mode: str = "run", reasons: Iterable[str] = ()
) -> Recording:
    """What a run leaves before its report; the recording that was fed live."""
    data = RunData(fleet, mode=mode)
    toml = tomli_w.dumps(to_dict(fleet))
    (folder / "fleet.toml").write_text(toml)
    with Recorder(folder / "run.mcap", fleet, mode=mode, fleet_toml=toml) as recorder:
        for received_ns, key, message in sent:
            recorder.record(received_ns, key, encode(message))
            data.feed(received_ns, key, message)
        recorder.set_outcome(list(reasons))
    return data.recording(reasons=list(reasons))


def finish(folder: Path, recording: Recording) -> dict[str, Any]:
    return write_result(folder, RunResult(recording)).metrics


def good_run() -> Iterator[Sent]:
    return messages(FLEET, in_formation(FLEET, 0.3, calm_s=0.4))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Figures of a good run, by name."""
    return draw(tmp_path_factory.mktemp("drawn"), FLEET, good_run())


@pytest.fixture
def drawn_before(drawn: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn: those figures are put into the folder, for a test of what the page says."""

    def put(folder: Path, *_: object) -> dict[str, Path]:
        return {name: Path(shutil.copy(path, folder)) for name, path in drawn.items()}

    monkeypatch.setattr(figures, "write_figures", put)


@pytest.mark.slow
def test_live_and_rebuilt_reports_are_the_same_bytes(tmp_path: Path) -> None:
    recording = leave_run(tmp_path, FLEET, good_run())
    found = finish(tmp_path, recording)
    assert found["verdict"]["passed"]
    live = {name: (tmp_path / name).read_bytes() for name in FILES}
    for name in FILES:
        (tmp_path / name).unlink()
    assert rebuild(tmp_path).metrics == found
    assert {name: (tmp_path / name).read_bytes() for name in FILES} == live
    assert json.loads(live["metrics.json"]) == found


def test_the_page_needs_nothing_beside_itself(tmp_path: Path) -> None:
    finish(tmp_path, leave_run(tmp_path, FLEET, good_run()))
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    sources = [attributes["src"] for tag, attributes in page.tags if tag == "img"]
    assert len(sources) == len(NAMES)
    for source, name in zip(sources, NAMES, strict=True):
        assert source is not None
        prefix, _, data = source.partition(",")
        assert prefix == "data:image/png;base64"
        assert base64.b64decode(data) == (tmp_path / f"{name}.png").read_bytes()
    tags = {tag for tag, _ in page.tags}
    assert not tags & {"script", "link", "object"}
    (player,) = [attributes for tag, attributes in page.tags if tag == "iframe"]
    assert player["sandbox"] == "allow-scripts"  # it cannot reach the page around it, nor where that lies
    assert "src" not in player
    assert player["srcdoc"].startswith("<!doctype html>")
    assert not re.findall(r"(?:href|src|url\()\s*=?\s*[\"']?(?!data:)\w+:", text)
    assert all(attributes.get("alt") for tag, attributes in page.tags if tag == "img")


@pytest.mark.usefixtures("drawn_before")
def test_a_good_run_is_said_to_be_one(tmp_path: Path) -> None:
    found = finish(tmp_path, leave_run(tmp_path, FLEET, good_run()))
    page = Page((tmp_path / "report.html").read_text())
    settled = found["settling_time_s"]
    assert f"The fleet was in formation after {settled:.1f} s and stayed so to the end." in page.text
    assert "Passed" in page.text
    assert "What to try" not in page.text
    assert "handfast run fleet.toml --seed 0" in page.text
    assert 'name = "made-up"' in page.text


@pytest.mark.usefixtures("drawn_before")
def test_a_failed_run_says_why_and_what_to_try(tmp_path: Path) -> None:
    sent = messages(FLEET, in_formation(FLEET, 1.5, calm_s=1e9))
    found = write_result(
        tmp_path, RunResult(leave_run(tmp_path, FLEET, sent, reasons=["Robot 2's agent died: <boom>."]))
    ).metrics
    page = Page((tmp_path / "report.html").read_text())
    assert "Failed" in page.text
    assert found["verdict"]["reasons"][0] == "Robot 2's agent died: <boom>."
    for reason in found["verdict"]["reasons"]:
        assert reason in page.text
    assert "What to try" in page.text
    assert "drive for longer" in page.text


@pytest.mark.usefixtures("drawn_before")
def test_a_failed_run_with_a_released_robot_says_how_it_drives_on(tmp_path: Path) -> None:
    def told(state: str) -> str:
        sent = messages(FLEET, in_formation(FLEET, 1.5, calm_s=1e9), state=state)
        folder = tmp_path / state
        folder.mkdir()
        finish(folder, leave_run(folder, FLEET, sent))
        return Page((folder / "report.html").read_text()).text

    assert "handfast resume" in told("released")
    assert "handfast resume" not in told("running")


def test_texts_of_others_are_escaped(tmp_path: Path) -> None:
    """Descriptions, reasons of states and names of counters come from outside."""
    attack = '<script>alert("x")</script>&amp;'
    fleet = replace(FLEET, fleet=replace(FLEET.fleet, description=attack))
    sent = []
    for received_ns, key, message in messages(fleet, in_formation(fleet)):
        if type(message) is Status:
            message = message._replace(state="fault", reason=attack, counters=((f"rejected.{attack}", 1),))
        sent.append((received_ns, key, message))
    finish(tmp_path, leave_run(tmp_path, fleet, sent, reasons=[attack]))
    page = Page((tmp_path / "report.html").read_text())
    assert "script" not in {tag for tag, _ in page.tags}
    # Title line, verdict, six robots' reasons twice, one counter, the fleet file.
    assert page.text.count(attack) >= 9


@pytest.mark.usefixtures("drawn_before")
def test_virtual_time_has_no_tick_time(tmp_path: Path) -> None:
    found = finish(tmp_path, leave_run(tmp_path, FLEET, good_run(), mode="simulate"))
    assert found["tick"]["p50_us"] is None
    page = Page((tmp_path / "report.html").read_text())
    assert "in virtual time" in page.text
    assert "started" not in page.text.split("Passed")[0]


@pytest.mark.usefixtures("drawn_before")
def test_the_page_says_what_was_kept_what_changed_and_who_was_in_which_state(tmp_path: Path) -> None:
    """The formation is to stand 10 m further off from 1 s on, and nobody goes there."""
    assert FLEET.formation.offsets is not None
    places = enumerate(FLEET.formation.offsets, start=1)
    robots = tuple((robot, x, y + 10.0) for robot, (x, y) in places)
    first, *sent = good_run()
    assert type(first[2]) is Mission
    moved = first[2]._replace(
        version=2, from_ns=first[2].epoch_ns + 10**9, note="<moved>", robots=robots, edges=((1, 2, 1.5),)
    )
    told = []
    for received_ns, key, message in sent:
        if type(message) is Status:
            message = message._replace(mission_version=2)
            if message.robot == 2 and received_ns > moved.from_ns + 10**9:
                message = message._replace(state="degraded", transition="row <b>", reason="why <b>")
        told.append((received_ns, key, message))
    sent = [first, (first[0], first[1], moved), *told]
    found = finish(tmp_path, leave_run(tmp_path, FLEET, sent))
    assert [(each["t_s"], each["note"], each["settled_after_s"]) for each in found["changes"]] == [
        (1.0, "<moved>", None)
    ]
    text = Page((tmp_path / "report.html").read_text()).text
    for words in (
        "Changes of mission", "<moved>", "What must always hold", "separation", "does not apply", "row <b>",
        "why <b>", "runningdegraded",
    ):  # fmt: skip
        assert words in text
    assert found["oracles"]["separation"] == {"checked": True, "violations": 0, "first": None}
    assert "violated" not in text


@pytest.mark.usefixtures("drawn_before")
def test_the_page_names_an_oracle_that_was_violated(tmp_path: Path) -> None:
    close = [standing(0.1 * robot, 0.0) for robot in range(len(FLEET.robots))]
    found = finish(tmp_path, leave_run(tmp_path, FLEET, messages(FLEET, close)))
    sentence = found["oracles"]["separation"]["first"]
    text = Page((tmp_path / "report.html").read_text()).text
    assert f"violated: {sentence} (1 more)" in text
    assert text.count(sentence) == 2  # the verdict's reasons have it, too
    assert "Changes of mission" not in text


@pytest.mark.usefixtures("drawn_before")
def test_a_truncated_recording_is_reported_with_a_note(tmp_path: Path) -> None:
    leave_run(tmp_path, FLEET, good_run())
    content = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) // 2])
    found = rebuild(tmp_path).metrics
    (reason,) = found["verdict"]["reasons"]
    assert reason.startswith("The recording is damaged: run.mcap ends after ")
    assert "is cut short or damaged" in Page((tmp_path / "report.html").read_text()).text


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    recording = leave_run(tmp_path, FLEET, good_run())
    (tmp_path / "distances.png").mkdir()
    with pytest.raises(RecordingError, match=r"^cannot write .*distances\.png: Is a directory$"):
        write_report(tmp_path, RunResult(recording))


# --- figures ---------------------------------------------------------------------------------


def size_of(path: Path) -> tuple[int, int]:
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", header[16:24])
    return width, height


def draw(folder: Path, fleet: Fleet, sent: Iterable[Sent]) -> dict[str, Path]:
    recording = recorded(fleet, sent)
    return figures.write_figures(folder, RunResult(recording))


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_fleets_of_any_size_are_drawn(tmp_path: Path, rows: int) -> None:
    fleet = make_fleet(*triangle(rows), velocity=(0.2, 0.0), duration_s=1.0, rate_hz=10)
    paths = draw(tmp_path, fleet, messages(fleet, in_formation(fleet, 0.2)))
    assert set(paths) == set(NAMES) - ({"distances"} if rows == 1 else set())
    for path in paths.values():
        width, height = size_of(path)
        assert 500 <= width <= 1500
        assert 400 <= height <= 1500


def test_runs_with_holes_are_drawn(tmp_path: Path) -> None:
    nothing_of_2 = [each for each in good_run() if "robot/2/" not in each[1]]
    poses_only = [
        each
        for each in good_run()
        if "plant/state" in each[1] or each[1] == key_expressions.mission("made-up")
    ]
    assert set(draw(tmp_path, FLEET, nothing_of_2)) == set(NAMES)
    assert set(draw(tmp_path, FLEET, poses_only)) == {"trajectories", "distances"}
    assert set(draw(tmp_path, FLEET, [])) == {"trajectories"}
    for name in figures.PICTURES:  # who asks for it has it all the same, with a note
        assert figures.figure(RunResult(recorded(FLEET, [])), name).axes


def test_no_text_of_software_or_date_is_in_a_figure(drawn: dict[str, Path]) -> None:
    for path in drawn.values():
        chunks = set(re.findall(rb"(tEXt|iTXt|zTXt|tIME)", path.read_bytes()[:200]))
        assert not chunks


def test_drawing_leaves_no_setting_behind_and_heeds_none(drawn: dict[str, Path], tmp_path: Path) -> None:
    plain = drawn["forces"].read_bytes()
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 20.0, "axes.facecolor": "black"}):
        again = draw(tmp_path, FLEET, good_run())["forces"].read_bytes()
        assert mpl.rcParams["font.size"] == 20.0
    assert again == plain


def test_the_formation_is_drawn_at_start_and_end_and_where_it_is_apart() -> None:
    def moments(trajectory: TrajectorySection) -> list[float]:
        fleet = replace(FLEET, trajectory=trajectory)
        recording = recorded(fleet, messages(fleet, in_formation(fleet)))
        a = analyse(recording, resolve(fleet))
        return [float(a.grid[k]) for k in trajectory_figure._moments(a)]

    assert moments(TrajectorySection("hold")) == [0.0, 3.0]
    assert moments(TrajectorySection("line", velocity_mps=(2.0, 0.0))) == pytest.approx(
        [0, 0.75, 1.5, 2.25, 3], abs=0.06
    )
    # 0.6 m in all is not half the formation's width: one more between would be a blur.
    assert moments(TrajectorySection("line", velocity_mps=(0.2, 0.0))) == [0.0, 3.0]


def test_the_figures_are_not_blank(drawn: dict[str, Path]) -> None:
    from matplotlib.image import imread

    for path in drawn.values():
        ink = np.asarray(imread(path))[..., :3].min(axis=2) < 0.9
        assert 0.005 < ink.mean() < 0.5


def test_robots_that_are_not_heard_are_in_the_table_and_on_the_map(tmp_path: Path) -> None:
    def beacon(robot: int, t: float, *silent: Silent) -> Sent:
        ns = EPOCH_NS + round(t * 1e9)
        said = Beacon(robot, 1, ns, True, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 0, -1, -1, silent, (2,))
        return ns, key_expressions.beacon(FLEET.fleet.name, robot), said

    row = Silent(2, EPOCH_NS - 9 * 10**9, True, 7.0, 3.0, 0.0, 0.0, 7.5, 3.0, 0.2)
    sent = [*messages(FLEET, in_formation(FLEET)), beacon(1, 2.0, row), beacon(1, 9.0)]  # long after the end
    data = RunData(FLEET)
    for each in sent:
        data.feed(*each)
    result = RunResult(data.recording())
    page = Page(write_report(tmp_path, result).read_text())
    assert "Robots that are not heard" in page.text
    assert "between (7.00, 3.00) and (7.50, 3.00), give or take 0.20 m" in page.text
    (axes,) = trajectory_figure.trajectories(result).axes
    (body,) = [patch for patch in axes.patches if patch.get_hatch()]
    low, high = body.get_path().get_extents().get_points()
    radius = 0.2 + 0.5 * FLEET.formation.safe_distance_m
    assert [*low, *high] == pytest.approx([7 - radius, 3 - radius, 7.5 + radius, 3 + radius], abs=0.01)
    assert axes.get_xlim()[1] > 7.5
    assert "2: silent for 11 s" in [text.get_text() for text in axes.texts]
    without = RunResult(replace(result.recording, beacons={}))
    assert "not heard" not in Page(write_report(tmp_path, without).read_text()).text
