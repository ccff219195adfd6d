"""A real Chromium, without a window, that tests drive."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

expect.set_options(timeout=30_000)  # ms, as what else waits: other tests use the machine too
NAMES = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE 127.0.0.2",
]
"""CI is root, which has no sandbox. No name is looked up: a page that asked for one would be seen."""


@contextmanager
def opened(
    screenshots: Path,
    width: int = 1400,
    height: int = 850,
    scheme: str = "light",
    may_say: str = "\0",
    *,
    strange: bool = False,
) -> Iterator[Page]:
    """A page of a browser; errors of its scripts, but those that contain `may_say`, and requests to others,
    fail the test.

    Args:
        strange: goes on where it does not know who has signed a server's certificate.

    When the test fails, what the page showed is left in `screenshots`.
    """
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"no browser: {', '.join(NAMES)} (Debian: apt install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        page = browser.new_page(
            viewport={"width": width, "height": height},
            color_scheme=scheme,  # type: ignore[arg-type]
            ignore_https_errors=strange,
        )
        trouble: list[str] = []
        asked: list[str] = []
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on("console", lambda said: trouble.append(said.text) if said.type == "error" else None)
        page.on("request", lambda request: asked.append(request.url))
        try:
            yield page
            assert not [text for text in trouble if may_say not in text]
            outside = ("http://127.0.0.1:", "https://127.0.0.2:", "data:", "file:", "about:")
            assert not [address for address in asked if not address.startswith(outside)]
        except BaseException:
            screenshots.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=screenshots / "failed.png")
            raise
        finally:
            browser.close()
