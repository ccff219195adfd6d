"""The page and its files are there, and nothing else is."""

from __future__ import annotations

import pytest

from handfast.deploy.playback.page import MODULES, STYLE, asset, served
from handfast.deploy.view.files import page_files


@pytest.mark.parametrize("what", ["live", "recorded"])
def test_the_page_and_its_files_are_there(what: str) -> None:
    answer = page_files(what)
    page = answer("")
    assert page is not None
    assert (page.body, page.kind) == (served(what), "text/html; charset=utf-8")
    assert f'data-shows="{what}"'.encode() in page.body
    for name in (*MODULES, STYLE):
        found = answer(name)
        assert found is not None
        assert found.body == asset(name)
        assert found.kind == f"text/{'css' if name == STYLE else 'javascript'}; charset=utf-8"


def test_there_is_nothing_else() -> None:
    answer = page_files("live")
    for path in ("index.html", "live", "main.js/", "../page/main.js", "/main.js", "main", "a.js", "."):
        assert answer(path) is None
