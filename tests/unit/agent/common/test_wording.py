"""Values in words are short and on one line."""

from __future__ import annotations

from typing import Any

from handfast.agent.common.reader import Problem
from handfast.agent.common.wording import did_you_mean, printable, show


def test_shown_values_are_short_and_on_one_line() -> None:
    deep: list[Any] = []
    for _ in range(10_000):
        deep = [deep]
    for value in ("x" * 10_000, list(range(10_000)), deep, 1 << 100_000, {"a\nb": "\x00"}, "\x1b[31m"):
        text = show(value)
        assert len(text) <= 60
        assert text.isprintable()
    assert printable("a\tb\ud800") == "a\\tb\\ud800"
    assert str(Problem("", "only this")) == "only this"


def test_what_was_meant_is_like_what_was_written() -> None:
    names = ("drive", "down", "resume", "remove", "reserve", "completion")
    for name, most, question in (
        ("drvie", 1, "did you mean drive?"),
        ("driv", 3, "did you mean drive?"),
        ("reserv", 1, "did you mean reserve?"),
        ("reserv", 2, "did you mean reserve or resume?"),
        ("reseve", 3, "did you mean reserve, resume or remove?"),
        ("com", 1, "did you mean completion?"),  # its beginning, which is too little to be like it
        ("co", 1, ""),
        ("", 1, ""),
        ("nothing", 3, ""),
        ("drive" * 20, 1, ""),
    ):
        assert did_you_mean(name, names, most=most) == question, name
    assert did_you_mean("drvie", iter(names), show) == 'did you mean "drive"?'
    assert did_you_mean("drive", ()) == ""
