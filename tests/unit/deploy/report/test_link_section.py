"""The links' part of a report and its pictures."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from handfast.deploy.recording.columns import Store
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.rows import StatusRows
from handfast.deploy.recording.tables import EXACT
from handfast.deploy.report import links
from handfast.deploy.report.links import advice
from handfast.deploy.report.run_folder import rebuild, write_result
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.simulated_run import driven, leave_run, recorded, trio

FAULTS = """
[faults]
delay = "60ms 20ms"
[[faults.rule]]
name = "<b>cut</b>"
link = "1<->2"
loss = "100%"
at = 0.5
for = 0.5
[[faults.rule]]
name = "crash"
robot = 3
kill = "plant"
at = 1.2
for = 0.2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with faults."""
    fleet = trio(FAULTS)
    path = leave_run(tmp_path_factory.mktemp("links") / "run", fleet, driven(fleet))
    rebuild(path)
    return path


def text_of(page: str) -> str:
    return unescape(re.sub(r"<[^>]*>", "", page))


def test_the_section_says_what_was_done_to_messages(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    start = page.index("<h2>Links</h2>")
    words = text_of(page[start : page.index("<h2>Forces", start)])
    assert re.search(r"Of [\d,]+ messages under fault rules, beacons left out, \d+ were lost \(\d+\.", words)
    assert re.search(r"were made to wait \d+\.\d ms on average, (7\d|80) at most", words)
    assert "loss 100% (<b>cut</b>, from 0.5 to 1 s); delay 60ms 20ms" in words
    assert "<b>cut" not in page
    picture = base64.b64encode((folder / "links.png").read_bytes()).decode()
    assert picture in page


def test_the_distances_figure_says_that_faults_are_above(folder: Path) -> None:
    assert "Above it, what was made to fail on purpose, and when." in (folder / "report.html").read_text()


def test_rebuilt_it_is_the_same_bytes(folder: Path) -> None:
    names = ("report.html", "metrics.json", "links.png", "distances.png")
    before = {name: (folder / name).read_bytes() for name in names}
    rebuild(folder)
    assert {name: (folder / name).read_bytes() for name in names} == before


def test_without_faults_there_is_no_section(tmp_path: Path) -> None:
    fleet = trio(duration=1.0)
    sent = driven(fleet)
    write_result(leave_run(tmp_path, fleet, sent), RunResult(recorded(fleet, sent)))
    assert not (tmp_path / "links.png").exists()
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Links</h2>" not in page
    assert "made to fail" not in page


# --- the table --------------------------------------------------------------------------------


def link(number: int, rate: float, age: float, asked: str = "loss 9%") -> dict[str, Any]:
    delay = {"mean": None, "p50": None, "p95": None, "max": None}
    counts = dict.fromkeys(("duplicated", "corrupted", "reordered", "overflow", "range"), 0)
    return {
        "link": f"{number}->{number + 1}", "topic": "hand", "asked": asked, "decided": 100,
        "injected": {"lost": 9, "rate": rate, **counts, "delay_ms": delay},
        "measured": {"sent": 100, "received": 91, "lost": 9},
        "age_ms": {"mean": age, "p50": age, "p95": age, "p99": age, "max": age},
    }  # fmt: skip


def found_with(links: list[dict[str, Any]], **rest: Any) -> dict[str, Any]:
    injected = {**link(1, 0.1, 20.0)["injected"], "decided": 100}
    age = {"p50": 20.0, "p99": 20.0, "max": 20.0}
    found = {
        "links": links,
        "injected": injected,
        "clock_offsets": [],
        "age_of_information_ms": age,
    }
    return found | rest


@pytest.fixture(scope="module")
def quiet() -> Recording:
    fleet = trio(duration=0.5)
    return recorded(fleet, driven(fleet))


def test_advice_on_links() -> None:
    fleet = trio(duration=0.5)
    off = replace(fleet, control=replace(fleet.control, prediction=False))
    late = {"p50": 300.0, "p99": 900.0, "max": 2500.0}
    recording = recorded(fleet, driven(fleet))
    unpredicted = replace(recording, fleet=off)
    found = found_with([link(1, 0.1, 20.0)], age_of_information_ms=late)
    assert [tip[:20] for tip in advice(recording, found)] == ["A neighbour's state "]
    assert "2.5 s old, more than" in advice(recording, found)[0]
    assert "prediction is off" in advice(unpredicted, found)[0]
    assert advice(recording, found_with([])) == []


# --- pictures ---------------------------------------------------------------------------------


def test_runs_with_holes_are_drawn(folder: Path, quiet: Recording) -> None:
    whole = read_run(folder)
    mute = StatusRows(1, Store()).table(0, EXACT)
    empty = replace(quiet, robots={robot: replace(d, status=mute) for robot, d in quiet.robots.items()})
    for recording in (whole, quiet, empty, replace(whole, epoch_ns=None, missions=())):
        links.links(RunResult(recording))
