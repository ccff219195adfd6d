"""A browser is opened where somebody can see it."""

from __future__ import annotations

import sys
import webbrowser

import pytest

from handfast.deploy.view.browser import open_browser


@pytest.mark.parametrize(
    ("display", "opens"), [({}, False), ({"DISPLAY": ":0"}, True), ({"WAYLAND_DISPLAY": "w"}, True)]
)
def test_only_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch, display: dict[str, str], opens: bool
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in display.items():
        monkeypatch.setenv(name, value)
    assert open_browser("http://here/") is opens
    assert opened == (["http://here/"] if opens else [])


def test_one_that_cannot_be_opened_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: str) -> bool:
        raise webbrowser.Error("no")

    monkeypatch.setattr(webbrowser, "open", fails)
    monkeypatch.setenv("DISPLAY", ":0")
    assert not open_browser("http://here/")
