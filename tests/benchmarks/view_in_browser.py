"""The page in a real Chromium: how soon a frame is on the screen, how soon any moment of a recording is seen,
and how large the page is.

Frames are those of 6 robots on real processes. A moment is one of an hour's recording of them in virtual
time, by a click on the line of time; nothing about it was fetched before. It is shown when the page says that
it shows it from the recording's own rows (`data-exact`).
"""

from __future__ import annotations

import random
import shutil
import subprocess
import tempfile
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

import numpy as np
from playwright.sync_api import FloatRect, Page

from tests.benchmarks.driven_fleet import driving
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.processes import BenchmarkError, NotHereError, environment, handfast
from tests.benchmarks.view_server import served
from tests.process.chromium import NAMES, opened

FRAME_MS: Final = 50.0
MOMENT_MS: Final = 200.0
PAGE_KB: Final = 150.0
SETTLE_S: Final = 3.0
MOMENTS: Final = 40
PAUSE_MS: Final = 200
"""Before a click, at least; up to twice as long."""
MARGIN_PX: Final = 12
"""At both ends of the line of time, where no moment is."""
READ_S: Final = 300.0
"""A recording has been read by then."""
SEED: Final = 1

_EXACT: Final = 'body[data-exact="true"]'
_FOLLOW_FRAMES: Final = """() => {
    const { source } = handfast;
    const { moved, drawn } = source;
    let waiting = [];
    source.sinceMade = [];
    source.delays.length = 0;
    source.moved = function (data) {
        const before = this.received;
        moved.call(this, data);
        if (this.received > before) waiting.push(1000 * this.made);
    };
    source.drawn = function () {
        drawn.call(this);
        this.sinceMade.push(...waiting.map((made) => Date.now() - made));
        waiting = [];
    };
}"""
_SIZES: Final = """() => ["navigation", "resource"]
    .flatMap((kind) => performance.getEntriesByType(kind))
    .map((entry) => entry.decodedBodySize)"""
_FOLLOW_MOMENTS: Final = """() => {
    const { body } = document;
    let begun = null;
    handfast.tookMs = [];
    addEventListener("pointerdown", (event) => {
        begun = event.timeStamp;
        delete body.dataset.exact; // that of what was shown before
    }, { capture: true });
    new MutationObserver(() => {
        if (begun === null || body.dataset.exact !== "true") return;
        handfast.tookMs.push(performance.now() - begun);
        begun = null;
    }).observe(body, { attributeFilter: ["data-exact"] });
}"""
_SHOWN: Final = "(count) => handfast.tookMs.length === count"
_NOTHING_ON_ITS_WAY: Final = "() => handfast.source.waiting.size === 0"
_FORGET: Final = "() => handfast.source.pieces.clear()"


class _Live(NamedTuple):
    """Of the page of a fleet: for each frame that is drawn, how long ago it came to the page, ms; for each
    that came, how long ago the server made it when it, or a newer one, is drawn, ms; bytes of its files."""

    arrived_ms: list[float]
    made_ms: list[float]
    sizes: list[int]


def run(options: Options) -> Result:
    if not any(map(shutil.which, NAMES)):
        raise NotHereError(f"no browser: {', '.join(NAMES)} (Debian: apt install chromium)")
    window_s, recorded_s = (10.0, 300) if options.quick else (30.0, 3600)
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        live = _live(Path(name), window_s)
        moments_ms = _moments(Path(name), recorded_s)
    return Result(
        [
            _p99("frame in the page to drawn", live.arrived_ms),
            _p99("frame made by the server to drawn", live.made_ms),
            Figure(f"any moment of {recorded_s // 60} min, slowest", max(moments_ms), "ms", MOMENT_MS,
                   note=f"median {median(moments_ms):.0f}, of {len(moments_ms)}"),
            Figure("the page", sum(live.sizes) / 1e3, "kB", PAGE_KB, note=f"{len(live.sizes)} files"),
        ]
    )  # fmt: skip


def _p99(name: str, took_ms: list[float]) -> Figure:
    note = f"median {median(took_ms):.0f}, of {len(took_ms)}"
    return Figure(f"{name}, p99", float(np.percentile(took_ms, 99)), "ms", FRAME_MS, note=note)


def _live(folder: Path, window_s: float) -> _Live:
    with (
        driving(folder) as (_, fleet_file, _, observer),
        served(fleet_file, folder) as (_, address),
        opened(folder) as page,
    ):
        page.goto(address)
        page.wait_for_function("() => window.handfast && handfast.source.end > 0")
        observer.watch(SETTLE_S)
        page.evaluate(_FOLLOW_FRAMES)
        observer.watch(window_s)
        arrived_ms, made_ms = page.evaluate("[handfast.source.delays, handfast.source.sinceMade]")
        sizes = page.evaluate(_SIZES)
    if not arrived_ms:
        raise BenchmarkError("the page draws no frames")
    return _Live(arrived_ms, made_ms, sizes)


def _moments(folder: Path, duration_s: int) -> list[float]:
    """From a click on the line of time until the page shows that moment of a recording, ms, of each click."""
    recording = folder / "recording"
    words = ("simulate", "delta", "--duration", f"{duration_s}", "--quiet", "--no-report")
    done = subprocess.run(
        handfast(*words, "--out", str(recording)), env=environment(), capture_output=True, check=False
    )
    if done.returncode not in (0, 1):  # 1: it ran, and its verdict failed
        raise BenchmarkError(f"handfast simulate: {done.stderr.decode(errors='replace')[-500:]}")
    with served(recording, folder, READ_S) as (_, address), opened(folder) as page:
        page.goto(address)
        page.wait_for_selector(_EXACT)
        page.evaluate(_FOLLOW_MOMENTS)
        line = page.locator("#line").bounding_box()
        if line is None:
            raise BenchmarkError("the page has no line of time")
        return _clicks(page, line)


def _clicks(page: Page, line: FloatRect) -> list[float]:
    draws = random.Random(SEED)
    places = draws.sample(range(MARGIN_PX, int(line["width"]) - MARGIN_PX), MOMENTS)
    for count, place in enumerate(places, 1):
        page.wait_for_function(_NOTHING_ON_ITS_WAY)
        page.evaluate(_FORGET)
        page.wait_for_timeout(PAUSE_MS * (1.0 + draws.random()))
        page.mouse.click(line["x"] + place, line["y"] + line["height"] / 2)
        page.wait_for_function(_SHOWN, arg=count)
    took_ms: list[float] = page.evaluate("handfast.tookMs")
    return took_ms
