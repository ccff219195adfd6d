"""The links' part of a report and its pictures."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.messages.types import Event
from handfast.deploy.faults.windows import WINDOWS_MAX, windows
from handfast.deploy.recording.columns import Store
from handfast.deploy.recording.link_table import EXACT
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.rows import StatusRows
from handfast.deploy.report import link_figure
from handfast.deploy.report.drawing import fault_strip
from handfast.deploy.report.drawing.plotting import write
from handfast.deploy.report.link_section import ROWS_MAX, advice, section
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
    counts = dict.fromkeys(("duplicated", "corrupted", "reordered", "held", "overflow", "range"), 0)
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


def test_of_many_links_the_worst_are_shown_in_their_order(quiet: Recording) -> None:
    links = [link(k, 0.1, 20.0 + (k % 7)) for k in range(1, 91)]
    words = text_of(section(quiet, found_with(links), None))
    assert f"The worst {ROWS_MAX} of 90 links" in words
    shown = [int(number) for number in re.findall(r"(\d+)→", words)]
    assert len(shown) == ROWS_MAX
    assert shown == sorted(shown)
    assert {k for k in range(1, 91) if k % 7 > 3} <= set(shown)


def test_what_all_links_were_asked_is_said_once(quiet: Recording) -> None:
    words = text_of(section(quiet, found_with([link(1, 0.1, 20.0), link(2, 0.1, 20.0)]), None))
    assert words.count("loss 9%") == 1
    two = [link(1, 0.1, 20.0), link(2, 0.1, 20.0, "loss 8%")]
    assert "AskedLost" in text_of(section(quiet, found_with(two), None))


def test_clocks_that_differ_are_said(quiet: Recording) -> None:
    offsets = [
        {"robot": 1, "neighbour": 2, "offset_ms": -30.0, "error_ms": 5.0},
        {"robot": 2, "neighbour": 3, "offset_ms": 60.0, "error_ms": 61.0},
    ]
    words = text_of(section(quiet, found_with([link(1, 0.1, 20.0)], clock_offsets=offsets), None))
    assert "at the end robot 2's was 30.0 ms behind robot 1's, within 5.0 ms" in words


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


def test_every_rule_has_a_lane_up_to_a_number() -> None:
    many = "".join(
        f'[[faults.rule]]\nname = "r{k}"\nlink = "1->2"\nloss = "9%"\nat = {k / 10}\nfor = 0.05\n'
        for k in range(12)
    )
    fleet = trio('[faults]\ndelay = "1ms"\n' + many)
    lanes = fault_strip.drawn_lanes(recorded(fleet, driven(fleet)), 2.0)
    assert len(lanes) == fault_strip.LANES_MAX
    assert lanes[0].text == "[faults]: delay 1ms on every link"
    assert lanes[1].text == "r0: loss 9% on 1->2"
    assert lanes[1].times == [(0.0, 0.05)]
    assert lanes[-1].text == "5 further rules"
    assert lanes[-1].times[0] == (pytest.approx(0.7), pytest.approx(0.75))


def test_a_rule_that_flickers_is_drawn_as_one_bar() -> None:
    flicker = Rule(at=1.0, duration=1e-4, every=2e-4)
    assert windows(flicker, 10.0) == [(1.0, 10.0)]
    assert windows(replace(flicker, until=5.0), 10.0) == [(1.0, 5.0)]
    slow = Rule(at=1.0, duration=0.5, every=1.0)
    assert windows(slow, 3.2) == [(1.0, 1.5), (2.0, 2.5), (3.0, 3.2)]
    assert len(windows(slow, float(WINDOWS_MAX))) == WINDOWS_MAX - 1


def test_links_are_drawn_where_messages_were_old(quiet: Recording) -> None:
    assert not link_figure.worth_drawing(RunResult(quiet))
    late = trio('[faults]\ndelay = "60ms"\n', duration=0.5)
    recording = recorded(late, driven(late))
    assert link_figure.worth_drawing(RunResult(recording))
    assert link_figure.worth_drawing(RunResult(replace(recording, links=quiet.links)))


def test_runs_with_holes_are_drawn(folder: Path, quiet: Recording) -> None:
    whole = read_run(folder)
    mute = StatusRows(1, Store()).table(0, EXACT)
    empty = replace(quiet, robots={robot: replace(d, status=mute) for robot, d in quiet.robots.items()})
    for recording in (whole, quiet, empty, replace(whole, epoch_ns=None, missions=())):
        link_figure.links(RunResult(recording))


@pytest.mark.parametrize("send", ["periodic", "event"])
def test_the_share_that_was_lost_is_of_what_was_sent(send: str) -> None:
    fleet = trio(f'[faults]\nloss = "20%"\n[control]\nsend = "{send}"\n', duration=8.0)
    drawn = link_figure._lost(recorded(fleet, driven(fleet)), 8.0)
    assert drawn is not None
    assert 14.0 < drawn[1].mean() < 26.0


def test_what_was_done_to_processes_is_marked(folder: Path) -> None:
    recording = read_run(folder)
    assert [event.what for event in recording.events] == ["kill", "start"]
    axes = link_figure.links(RunResult(recording)).axes
    texts = {text.get_text() for one in axes for text in one.texts}
    assert {"plant 3 killed", "plant 3 started"} <= texts
    assert any(text.startswith("<b>cut</b>: loss 100% on 1->2") for text in texts)


def test_a_dollar_in_the_name_of_a_rule_is_a_dollar(tmp_path: Path) -> None:
    fleet = trio('[[faults.rule]]\nname = "$\\\\nosuch$"\nlink = "1->2"\nloss = "9%"\n', duration=0.1)
    recording = recorded(fleet, driven(fleet))
    # TeX would not know it, and raise.
    write(tmp_path / "links.png", lambda: link_figure.links(RunResult(recording)))


def test_many_events_are_marked_without_words(quiet: Recording) -> None:
    epoch_ns = quiet.epoch_ns or 0
    events = [Event(1, k, epoch_ns + 10_000_000 * k, "agent", "stop", "x") for k in range(20)]
    (strip_free, *_) = link_figure.links(RunResult(replace(quiet, events=events))).axes
    assert not any("paused" in text.get_text() for text in strip_free.texts)
    assert len([line for line in strip_free.lines if line.get_color() == "#C1121F"]) == 20
