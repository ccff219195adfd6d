"""A running fleet in a real browser: what the page shows of it, and what its controls do to the robots."""

from __future__ import annotations

import os
import re
import secrets
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from math import dist
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from handfast.deploy.recording.mcap_reader import read_run
from tests.process.chromium import opened
from tests.process.fleet_harness import all_ready
from tests.process.harness import BUSY, Command, no_trouble_in_logs, wait_for
from tests.process.small_fleets import triangle

NETWORK = ("--set", "network.base_port=21120")
DRIVES = re.compile("running|degraded")
"""States of a robot that drives, on a machine that has too much to do as well."""
GONE = "ERR_CONNECTION_REFUSED"
"""What the browser says, besides the page, of a server that is gone."""


@contextmanager
def driving(folder: Path, base: str, duration_s: int, *more: str) -> Iterator[tuple[str, Command]]:
    """`handfast run` of a bundled fleet under a name of its own, driving; its folder is `folder` / out."""
    name = f"t-{secrets.token_hex(4)}"
    arguments = ("run", base, "--set", f"fleet.name={name}", "--duration", str(duration_s), *NETWORK, *BUSY)
    with Command(folder, *arguments, "--out", "out", "--no-report", *more) as command:
        command.wait_for_line("all running")
        command.children()
        yield name, command


@contextmanager
def viewed(folder: Path, *arguments: str) -> Iterator[tuple[str, Command]]:
    """`handfast view`: the address of its page; it ends by Ctrl-C, unless it was killed."""
    with Command(folder, "view", *arguments, "--no-browser") as command:
        yield address(command), command
        if command.process.poll() is None:
            command.process.send_signal(signal.SIGINT)
            assert command.wait() == 130


def address(command: Command) -> str:
    found = wait_for(lambda: re.search(r"http://\S+", command.out), "an address", report=command.told)
    assert found is not None
    return found[0]


def shown(page: Page, where: str) -> None:
    page.goto(where)
    page.wait_for_selector('body[data-exact="true"]')
    page.wait_for_function("() => handfast.source.end > 0")


def click_on(page: Page, place: str) -> None:
    """Clicks on a place of the plan: an expression that gives [x, y] on its canvas."""
    box = page.locator("#plan").bounding_box()
    assert box is not None
    x, y = page.evaluate(place)
    page.mouse.click(box["x"] + x, box["y"] + y)


def click_on_nothing(page: Page) -> None:
    click_on(page, "[15, handfast.plan.height / 2]")


def first_order(page: Page, text: str) -> None:
    """Waits until the newest order says so."""
    expect(page.locator("#change li").first).to_contain_text(text)


SILENT_BOTH_WAYS = """() => {
  const { links } = handfast.controls;
  const ids = handfast.scene.robots.map(({ id }) => id);
  const cells = [[1, 2], [2, 1]].map(([from, to]) => links.cells[1 + ids.indexOf(to)][1 + ids.indexOf(from)]);
  return cells.every((cell) => cell.classList.contains("bad") && cell.textContent.endsWith("100%"))
    && links.trouble(1, 2).startsWith("silent ");
}"""
"""Whether the list of links and the plan say so of the link between robots 1 and 2."""

ROBOTS_TAKE_LESS_ROOM = """() => {
  const { plan } = handfast;
  plan.fit(true);
  const near = plan.scale;
  plan.fit();
  return near > 1.1 * plan.scale;
}"""
"""Whether all that they have driven, since the page knows of them, takes more room than they do."""

MIDDLE_OF_LINK = (
    "(() => { const [i, j] = handfast.source.edgesAt(1e9)[0]; const { drawn } = handfast.plan;"
    " return [(drawn[i][0] + drawn[j][0]) / 2, (drawn[i][1] + drawn[j][1]) / 2]; })()"
)


NO_ROBOT_IS_NEAR_IT = f"""() => {{
  const [x, y] = {MIDDLE_OF_LINK};
  return Object.values(handfast.plan.drawn).every(([a, b]) => Math.hypot(a - x, b - y) > 40);
}}"""
"""True once no passing robot covers the middle of the link: a click there would choose the robot."""


@pytest.mark.alone  # beside others the machine may run late, and a fleet stands as long as it does
def test_every_control_does_to_the_robots_what_it_says(tmp_path: Path) -> None:
    with (
        driving(tmp_path / "run", "delta", 120) as (name, run),
        viewed(tmp_path / "view", name) as (where, _),
    ):
        with opened(tmp_path) as page:
            shown(page, where)
            expect(page.locator("#robots tbody tr")).to_have_count(6)
            expect(page.locator("#robots tbody tr").first).to_contain_text(DRIVES)

            # A rule on a link, as long as it was asked for.
            page.wait_for_function(NO_ROBOT_IS_NEAR_IT)
            click_on(page, MIDDLE_OF_LINK)
            expect(page.locator("#change .row")).to_contain_text("link 1 – 2")
            page.locator("#change button", has_text="all lost").click()
            first_order(page, "loss 100% on 1->2; 2->1 – 12 of 12")
            page.wait_for_function(SILENT_BOTH_WAYS)
            page.locator("#change button", has_text="heal all links").click()
            first_order(page, "heal all links – 12 of 12")
            click_on_nothing(page)

            # A link is chosen by its cell too.
            page.locator("#links td.choice").first.click()
            expect(page.locator("#change .row")).to_contain_text("link 1 – ")
            click_on_nothing(page)

            # All of the drive fits, or the robots alone; what was zoomed to is there again after a reload.
            page.wait_for_function(ROBOTS_TAKE_LESS_ROOM)
            whole = page.evaluate("handfast.plan.scale")
            page.keyboard.press("f")
            page.wait_for_function(f"() => handfast.plan.scale > {whole}")
            page.keyboard.press("+")
            zoomed = page.evaluate("handfast.plan.scale")
            page.reload()
            page.wait_for_function("() => window.handfast && handfast.source.end > 0")
            assert page.evaluate("handfast.plan.scale") == zoomed
            page.keyboard.press("f")
            page.wait_for_function(f"() => handfast.plan.scale < {zoomed}")

            # Robot 1 leaves, and comes back.
            click_on(page, "handfast.plan.drawn[0]")
            page.locator("#change button", has_text="take robot 1 out").click()
            first_order(page, "6 of 6")
            expect(page.locator("#robots tbody tr").first).to_contain_text("standby")
            page.locator("#change button", has_text="join robot 1 to").click()
            first_order(page, "6 of 6")
            expect(page.locator("#robots tbody tr").first).to_contain_text(DRIVES)
            click_on_nothing(page)

            # A place is dragged, what comes of it is checked, and then it is ordered.
            page.locator("#change button", has_text="reshape").click()
            box = page.locator("#plan").bounding_box()
            assert box is not None
            x, y = page.evaluate("handfast.plan.toScreen(...handfast.controls.reshape.places().get(6))")
            page.mouse.move(box["x"] + x, box["y"] + y)
            page.mouse.down()
            page.mouse.move(box["x"] + x + 8, box["y"] + y - 8, steps=3)
            page.mouse.up()
            page.locator("#change button:enabled", has_text="order it").click()
            first_order(page, "new places")
            first_order(page, "6 of 6")

            # STOP by its key, wherever the focus is; resume.
            page.locator("#speed").focus()
            page.keyboard.press("Escape")
            first_order(page, "stop – 6 of 6")
            expect(page.locator("#standing")).to_contain_text("stopped at")
            expect(page.locator("#robots tbody tr", has_text=DRIVES)).to_have_count(0)
            page.locator("#resume").click()
            first_order(page, "resume – 6 of 6")
            expect(page.locator("#standing")).to_be_empty()

            # What has been driven so far can be looked at, and the fleet goes on meanwhile.
            page.keyboard.press("Home")
            assert page.evaluate("handfast.t === handfast.source.rows[0]")  # the first that is known here
            expect(page.locator("#about")).to_contain_text("looking back")
            page.evaluate("handfast.seek(0)")  # of before nothing is known, and so nothing shown
            assert page.evaluate("handfast.t === handfast.source.rows[0]")
            page.locator("#events button", has_text="told to stop").click()
            expect(page.locator("#now")).to_have_attribute("aria-pressed", "false")
            page.evaluate("handfast.source.happened({ t_s: -1, kind: 'order', text: 'xyz', robots: [] })")
            expect(page.locator("#events button").first).to_contain_text("xyz")
            page.locator("#now").click()
            expect(page.locator("#about")).to_contain_text("live")
            expect(page.locator("#now")).to_have_attribute("aria-pressed", "true")
        run.process.send_signal(signal.SIGINT)
        run.wait()
    no_trouble_in_logs(tmp_path / "run" / "out")
    recording = read_run(tmp_path / "run" / "out")
    notes = [mission.note for mission in recording.missions]
    assert [next(note for note in notes if words in note) for words in ("leaves", "joins", "new places")]
    halts = {robot: recording.halts(robot) for robot in recording.ids}
    assert all(any(end - begin > 0.2 for begin, end in each) for each in halts.values()), halts
    assert recording.resumes


@pytest.mark.long
def test_a_body_that_is_not_heard_any_more_is_shown_where_it_was_seen_last(tmp_path: Path) -> None:
    with driving(tmp_path / "run", "pair", 60) as (name, run):
        with viewed(tmp_path / "view", name) as (where, _), opened(tmp_path) as page:
            shown(page, where)
            page.wait_for_function("() => handfast.plan.drawn.every(Boolean)")
            page.evaluate("""() => {
                const { plan } = handfast;
                const { seenLast } = plan;
                plan.seenLast = (robot, last) => {
                    handfast.lost = { id: robot.id, ...last };
                    return seenLast.call(plan, robot, last);
                };
            }""")
            plant = run.child(2, "plant")
            before_s = page.evaluate("handfast.source.now")
            os.kill(plant, signal.SIGSTOP)
            page.wait_for_function("() => handfast.lost !== undefined")
            lost = page.evaluate("handfast.lost")
            os.kill(plant, signal.SIGCONT)
            page.wait_for_function("() => handfast.plan.drawn.every(Boolean)")
        run.process.send_signal(signal.SIGINT)
        run.wait()
    assert lost["id"] == 2
    hand = read_run(tmp_path / "run" / "out").hand_positions(np.array([before_s]))[0][1]
    assert dist(hand, (lost["x"], lost["y"])) < 0.5


@pytest.mark.long
def test_a_server_that_is_killed_changes_nothing_for_the_robots(tmp_path: Path) -> None:
    with driving(tmp_path / "run", "pair", 60) as (name, run):
        with viewed(tmp_path / "view", name) as (where, view), opened(tmp_path, may_say=GONE) as page:
            shown(page, where)
            view.process.kill()
            view.process.wait()
            expect(page.locator("#problem")).to_contain_text("No connection to the server of this page")
            expect(page.locator("body")).to_have_class("stale")
        run.process.send_signal(signal.SIGINT)
        run.wait()
    recording = read_run(tmp_path / "run" / "out")
    assert {stop.reason for stop in recording.stops} == {"interrupted"}


@pytest.mark.long
def test_nothing_can_be_ordered_where_it_is_only_to_be_read(tmp_path: Path) -> None:
    with driving(tmp_path / "run", "pair", 60) as (name, run):
        with viewed(tmp_path / "view", name, "--read-only") as (where, _), opened(tmp_path) as page:
            shown(page, where)
            expect(page.locator("#about")).to_contain_text("to be looked at only")
            expect(page.locator("#stop")).to_be_hidden()
            page.keyboard.press("Escape")
            page.evaluate("handfast.source.say({ order: { id: 'x', kind: 'stop' } })")
            before = page.evaluate("handfast.source.number")
            page.wait_for_function(f"() => handfast.source.number > {before + 10}")
            expect(page.locator("#standing")).to_be_empty()
        run.process.send_signal(signal.SIGINT)
        run.wait()
    assert {stop.reason for stop in read_run(tmp_path / "run" / "out").stops} == {"interrupted"}


def test_without_its_token_a_page_is_told_nothing(tmp_path: Path) -> None:
    with driving(tmp_path / "run", "pair", 60) as (name, run):
        with viewed(tmp_path / "view", name) as (where, _), opened(tmp_path) as page:
            page.goto(where.partition("#")[0] + "#token=another")
            expect(page.locator("#problem")).to_contain_text("another token")
            assert page.evaluate("window.handfast === undefined")
        run.process.send_signal(signal.SIGINT)
        run.wait()


@pytest.mark.long
def test_a_run_is_viewed_live_and_then_its_recording(tmp_path: Path) -> None:
    arguments = ("run", "pair", "--duration", "6", "--view", "--out", "out", "--no-report", *NETWORK, *BUSY)
    with Command(tmp_path, *arguments) as command, opened(tmp_path) as page:
        page.goto(address(command))
        page.wait_for_selector('body[data-exact="true"]')
        expect(page.locator("#about")).to_contain_text("live")
        expect(page.locator("#about")).to_contain_text("recorded")  # at the end, by itself
        page.wait_for_selector('body[data-exact="true"]')
        assert page.evaluate("handfast.source.end") == pytest.approx(6.0, abs=0.1)
        command.process.send_signal(signal.SIGINT)
        assert command.wait() in (0, 1)


@pytest.mark.long
def test_a_mission_is_started_from_the_page(tmp_path: Path) -> None:
    settings = ("fleet.rate_hz=25", "control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5")
    with all_ready(triangle(*settings), tmp_path / "r") as fleet:
        with viewed(tmp_path / "view", str(fleet.fleet_file)) as (where, _), opened(tmp_path) as page:
            page.goto(where)
            page.wait_for_selector('body[data-exact="true"]')
            expect(page.locator("#time")).to_have_text("no mission yet")
            page.locator("#change button", has_text="start the mission").click()
            fleet.wait_until_all("running")
            first_order(page, "start the mission – 4 of 4")
            page.locator("#stop").click()
            first_order(page, "stop – 4 of 4")
        fleet.wait_until_all("stopped")


@pytest.mark.parametrize(("width", "scheme"), [(1400, "dark"), (420, "light")])
def test_stop_is_on_the_screen_and_nothing_is_wider(tmp_path: Path, width: int, scheme: str) -> None:
    with driving(tmp_path / "run", "pair", 60) as (name, run):
        with viewed(tmp_path / "view", name) as (where, _), opened(tmp_path, width, 850, scheme) as page:
            shown(page, where)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            box = page.locator("#stop").bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width + 1
            assert box["y"] >= 0
            assert box["y"] + box["height"] < 850
        run.process.send_signal(signal.SIGINT)
        run.wait()
