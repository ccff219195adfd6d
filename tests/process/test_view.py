"""A recorded run in a real browser: by the command ``handfast view``, and within its report."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from handfast.deploy.recording.mcap_reader import read_run
from tests.process.chromium import opened
from tests.process.harness import Command, wait_for

T = "handfast.t"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in which robot 3 is killed for a second, with its report."""
    folder = tmp_path_factory.mktemp("run")
    rule = '[[faults.rule]]\nname = "crash"\nrobot = 3\nkill = "agent"\nat = 6.0\nfor = 1.0\n'
    (folder / "crash.toml").write_text(rule)
    arguments = ("simulate", "delta", "--faults", str(folder / "crash.toml"), "--duration", "40")
    with Command(folder / "command", *arguments, "--out", str(folder / "run")) as command:
        assert command.wait() in (0, 1), command.told()
    return folder / "run"


@pytest.fixture
def address(run: Path, tmp_path: Path) -> Iterator[str]:
    """Of the page of `run`; its server ends by Ctrl-C, with nothing but its status."""
    with Command(tmp_path / "view", "view", str(run), "--no-browser") as command:
        found = wait_for(lambda: re.search(r"http://\S+", command.out), "an address", report=command.told)
        assert found is not None
        yield found[0]
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130


def ready(page: Page) -> None:
    page.wait_for_selector('body[data-exact="true"]')


def test_the_page_shows_any_moment(address: str, run: Path, tmp_path: Path) -> None:
    recording = read_run(run)
    with opened(tmp_path) as page:
        page.goto(f"{address}#t=5.00")
        ready(page)
        expect(page.locator("#robots tbody tr")).to_have_count(6)
        row = page.evaluate("Array.from(handfast.source.frame(5.0).row.slice(0, 2))")
        hand = recording.hand_positions(np.array([5.0]))[0, 0]
        assert row == pytest.approx(hand, abs=1e-3)

        # The keys: a tick on, a tick back, the end, the begin.
        page.keyboard.press("ArrowRight")
        assert page.evaluate(T) == pytest.approx(5.02)
        page.keyboard.press("ArrowLeft")
        assert page.evaluate(T) == pytest.approx(5.0)
        page.keyboard.press("End")
        assert page.evaluate(T) == pytest.approx(recording.end_s, abs=0.03)
        page.keyboard.press("Home")
        assert page.evaluate(T) == 0

        # A click in the middle of the line.
        box = page.locator("#line").bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert page.evaluate(T) == pytest.approx(recording.end_s / 2, abs=0.2)
        ready(page)


@pytest.mark.long
def test_a_page_that_stands_still_draws_nothing(address: str, tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.goto(address)
        ready(page)
        page.wait_for_timeout(500)
        page.evaluate(
            "() => { const draw = handfast.plan.draw; handfast.drawings = 0;"
            " handfast.plan.draw = function (frame) { handfast.drawings += 1; draw.call(this, frame); }; }"
        )
        page.wait_for_timeout(500)
        assert page.evaluate("handfast.drawings") == 0
        page.keyboard.press("t")  # what changes its look is drawn
        page.wait_for_timeout(500)
        assert page.evaluate("handfast.drawings") == 1


@pytest.mark.long
def test_a_click_on_what_happened_goes_there(address: str, tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.goto(address)
        ready(page)
        page.locator("#events button", has_text="agent 3 killed").click()
        assert page.evaluate(T) == pytest.approx(6.0, abs=0.05)
        expect(page.locator("#robots tr.chosen td").first).to_have_text("3")


@pytest.mark.long
def test_a_link_leads_to_the_moment(address: str, tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.goto(f"{address}#t=7.50")
        ready(page)
        page.keyboard.press("ArrowRight")
        page.keyboard.press("l")
        expect(page.locator("#link")).to_have_text("copied")
        assert page.evaluate("location.hash") == "#t=7.520"


@pytest.mark.long
def test_it_plays_as_fast_as_it_is_told(address: str, tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.goto(address)
        ready(page)
        page.locator("#speed").select_option("50")
        page.keyboard.press("Space")
        expect(page.locator("#time")).to_have_text("40.00 of 40.0 s")  # which as fast as it was takes longer
        expect(page.locator("#play")).to_have_text("play")


@pytest.mark.long
def test_a_page_whose_server_is_gone_says_so(run: Path, tmp_path: Path) -> None:
    with Command(tmp_path / "view", "view", str(run), "--no-browser") as command:
        found = wait_for(lambda: re.search(r"http://\S+", command.out), "an address", report=command.told)
        assert found is not None
        with opened(tmp_path, may_say="ERR_CONNECTION_REFUSED") as page:
            page.goto(found[0])
            ready(page)
            command.process.kill()
            command.process.wait()
            page.keyboard.press("End")
            expect(page.locator("#problem")).to_contain_text("The server that gives this recording is gone")


@pytest.mark.long
@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (420, "dark")])
def test_nothing_is_wider_than_the_screen(address: str, tmp_path: Path, width: int, scheme: str) -> None:
    with opened(tmp_path, width, 850, scheme) as page:
        page.goto(address)
        ready(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        for name in ("#play", "#line", "#plan", "#time"):
            box = page.locator(name).bounding_box()
            assert box is not None
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width + 1


def test_the_report_plays_from_the_disk(run: Path, tmp_path: Path) -> None:
    with opened(tmp_path) as page:
        page.goto((run / "report.html").as_uri())
        player = page.frame_locator("iframe")
        expect(player.locator("#robots tbody tr")).to_have_count(6)
        expect(player.locator("#problem")).to_be_hidden()
        player.locator("#events button", has_text="agent 3 killed").click()
        expect(player.locator("#time")).to_contain_text("6.0")


def test_the_server_gives_nothing_but_the_page_and_the_run(address: str) -> None:
    with urlopen(f"{address}scene", timeout=10) as answer:
        assert json.load(answer)["fleet"] == "delta"
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
