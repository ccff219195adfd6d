"""The page and its files, as a server gives them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from handfast.deploy.playback.page import asset, served
from handfast.deploy.view.server import Content

_KINDS: Final = {"js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8"}


def page_files(what: str) -> Callable[[str], Content | None]:
    """What there is at a path: the page, which shows `what` ("live" or "recorded"), and its files."""
    page = Content(served(what), "text/html; charset=utf-8")

    def answer(path: str) -> Content | None:
        if path == "":
            return page
        found = asset(path)
        return None if found is None else Content(found, _KINDS[path.rpartition(".")[2]])

    return answer
