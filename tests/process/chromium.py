"""A real Chromium, without a window, that tests drive."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

expect.set_options(timeout=30_000)  # ms, as what else waits: other tests use the machine too
NAMES = ("chromium", "chromium-browser", "google-chrome")
SERVERS = ("http://127.0.0.1", "https://127.0.0.2")
"""Of pages: the one that a server has unless told otherwise, and one that stands for a network's."""


def program() -> str:
    """This machine's Chromium; without one the test is skipped."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: {', '.join(NAMES)} (Debian: apt install chromium)")
    return found


def arguments(servers: Sequence[str]) -> list[str]:
    """CI is root, which has no sandbox. No name is looked up: a page that asked for one would be seen."""
    known = "".join(f", EXCLUDE {server.partition('://')[2]}" for server in servers)
    return ["--no-sandbox", "--disable-dev-shm-usage", f"--host-resolver-rules=MAP * ~NOTFOUND{known}"]


@contextmanager
def opened(
    screenshots: Path,
    width: int = 1400,
    height: int = 850,
    scheme: str = "light",
    may_say: str = "\0",
    *,
    strange: bool = False,
    by: str | Path | None = None,
    servers: Sequence[str] = SERVERS,
) -> Iterator[Page]:
    """A page of a browser; errors of its scripts, but those that contain `may_say`, and requests to others,
    fail the test.

    Args:
        strange: goes on where it does not know who has signed a server's certificate.
        by: the program, this machine's when left out. It talks over the descriptors 3 and 4 that it is given.
        servers: which requests may go to, at any port.

    When the test fails, what the page showed is left in `screenshots`.
    """
    executable = program() if by is None else by
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=arguments(servers))
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
            inside = (*(f"{server}:" for server in servers), "data:", "file:", "about:")
            assert not [address for address in asked if not address.startswith(inside)]
        except BaseException:
            screenshots.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=screenshots / "failed.png")
            raise
        finally:
            browser.close()
