"""The page is small, names no other server, and cannot be broken by what is in a recording."""

from __future__ import annotations

import base64
import hashlib
import re

import pytest

from handfast.deploy.console.data_files import PAGE
from handfast.deploy.playback.page import MODULES, STYLE, asset, embedded, served, served_policy

PAGE_BYTES_MAX = 150_000


def texts() -> list[str]:
    return [path.read_text("utf-8") for path in sorted(PAGE.iterdir())]


def test_all_files_of_the_page_are_served_and_no_others() -> None:
    assert {path.name for path in PAGE.iterdir()} == {*MODULES, STYLE, "index.html"}
    for name in (*MODULES, STYLE):
        assert asset(name) == (PAGE / name).read_bytes()
    for name in ("index.html", "../template.toml", "", "main.js/", "nothing.js"):
        assert asset(name) is None


def test_the_page_is_small() -> None:
    assert sum(len(text.encode()) for text in texts()) <= PAGE_BYTES_MAX


def test_no_request_leaves_the_machine() -> None:
    for text in [*texts(), embedded({}, b"")]:
        assert not re.search(r"(?:https?:)?//[a-z0-9]+\.[a-z]", text)


def test_every_import_is_a_module_of_the_page() -> None:
    imported = {
        name for text in texts() for name in re.findall(r'(?:from |import\()"handfast/([^"]+)"', text)
    }
    assert imported <= set(MODULES)
    assert imported | {"main.js"} == set(MODULES)


def test_nothing_is_made_of_text_as_html() -> None:
    for text in texts():
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", text)


@pytest.mark.parametrize("what", ["live", "recorded"])
def test_the_policy_allows_the_import_map_that_is_served(what: str) -> None:
    found = re.search(r'<script type="importmap">(.*?)</script>', served(what).decode())
    assert found is not None
    digest = base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
    assert f"'sha256-{digest}'" in served_policy()
    assert "unsafe" not in served_policy()


def test_text_of_a_recording_cannot_end_the_script_it_is_in() -> None:
    text = embedded({"fleet": "</script><script>alert(1)</script>"}, b"")
    assert "alert(1)</script>" not in text
    assert "\\u003c/script>\\u003cscript>alert(1)" in text
