"""The page of 45 robots that drive as real processes, in a real browser: all are seen, and one key stops
them."""

from __future__ import annotations

import re
import secrets
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations
from math import dist
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from handfast.agent.supervision.state_machine import DRIVING_NAMES
from handfast.deploy.recording.mcap_reader import read_run
from tests.process.chromium import opened
from tests.process.harness import BUSY, Command, measured, no_trouble_in_logs
from tests.process.test_view_live import NETWORK, click_on, first_order, shown, viewed

pytestmark = [pytest.mark.long, pytest.mark.alone]

ROBOTS = 45
SLOWLY = (*BUSY, "--set", "fleet.rate_hz=10")
"""A browser that draws without a graphics card takes one core of two."""
ON_THEIR_WAY = re.compile("running|degraded|holding")
"""States of a robot that drives, or stands for a while as its machine has too much to do."""
DOT_PX = 4.4
"""So wide is the dot of a hand point."""
WIDE, NARROW, HIGH = 1400, 420, 850
IN_SIGHT = f"""(width) => {{
  const {{ canvas, drawn, width: wide, height }} = handfast.plan;
  return innerWidth === width && wide === canvas.clientWidth && drawn.length === {ROBOTS}
    && drawn.every((at) => at && at[0] > 0 && at[0] < wide && at[1] > 0 && at[1] < height);
}}"""
"""Whether all are drawn on the canvas, as large as it is in a window so wide."""
ROWS = """(names) => {
  const { row, at, columns, scene } = handfast.source;
  return scene.robots.map((_, k) => names.map((name) => row[k * columns + at[name]]));
}"""
"""Some columns of the newest frame, of each robot."""
STAND = f"() => ({ROWS})(['speed']).every(([speed]) => speed < 0.001)"


@contextmanager
def lattice(folder: Path) -> Iterator[tuple[str, Command]]:
    """`handfast run` of the bundled fleet under a name of its own, begun; its folder is `folder` / out."""
    name = f"t-{secrets.token_hex(4)}"
    arguments = ("run", "lattice45", "--set", f"fleet.name={name}", "--duration", "300", *NETWORK)
    with Command(folder, *arguments, *SLOWLY, "--out", "out", "--no-report", "--no-check") as command:
        command.wait_for_line(r"(?m)^ +\d+\.\d s .*, closest ")
        command.children()
        yield name, command


def all_in_sight(page: Page, width: int) -> None:
    """Waits until each robot is drawn on the canvas, beside the others; nothing is wider than the window."""
    page.wait_for_function(IN_SIGHT, arg=width)
    drawn = page.evaluate("handfast.plan.drawn")
    closest_px = min(dist(*pair) for pair in combinations(drawn, 2))
    assert measured(f"the two closest on a page {width} wide, pixels", closest_px) > DOT_PX
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for each in ("#plan", "#stop"):
        box = page.locator(each).bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width


def test_all_of_45_robots_are_seen_where_they_are_and_stopped_by_a_key(tmp_path: Path) -> None:
    with lattice(tmp_path / "run") as (name, run):
        with viewed(tmp_path / "view", name) as (where, _), opened(tmp_path, WIDE, HIGH) as page:
            shown(page, where)
            rows = page.locator("#robots tbody tr")
            expect(rows).to_have_count(ROBOTS)
            expect(rows.filter(has_text=ON_THEIR_WAY)).to_have_count(ROBOTS)
            all_in_sight(page, WIDE)
            number, t_s = page.evaluate("[handfast.source.number, handfast.t]")
            page.wait_for_function(f"() => handfast.source.number > {number + 20}")
            page.wait_for_function(f"() => handfast.t > {t_s + 1.0}")
            page.set_viewport_size({"width": NARROW, "height": HIGH})
            all_in_sight(page, NARROW)
            page.set_viewport_size({"width": WIDE, "height": HIGH})
            all_in_sight(page, WIDE)

            page.keyboard.press("Escape")
            first_order(page, f"stop – {ROBOTS} of {ROBOTS}")
            expect(page.locator("#standing")).to_contain_text("stopped at")
            expect(rows.filter(has_text="stopped")).to_have_count(ROBOTS)
            page.wait_for_function(STAND)
            places = np.array(page.evaluate(ROWS, ["x", "y"]))
            for index in range(0, ROBOTS, 5):
                click_on(page, f"handfast.plan.drawn[{index}]")
                assert page.evaluate("handfast.chosen") == index
        run.process.send_signal(signal.SIGINT)
        run.wait()
    no_trouble_in_logs(tmp_path / "run" / "out")
    recording = read_run(tmp_path / "run" / "out")
    stop, interrupt = recording.stops
    assert (stop.reason, interrupt.reason) == ("", "interrupted")
    end_s = recording.fleet_time_s(interrupt.time_ns)
    for robot in recording.ids:
        status = recording.robots[robot].status
        told = [said[0] for at_s in (*status.t, end_s) if (said := status.at(at_s)) is not None]
        assert DRIVING_NAMES & {*told}, f"robot {robot} never drove: {told}"
        assert told[-1] == "stopped", f"robot {robot} is {told[-1]}"
    off = np.hypot(*(recording.hand_positions(np.array([end_s]))[0] - places).T)
    assert measured("farthest from where the page showed it, m", float(off.max())) < 0.01
