"""Values in words are short and on one line."""

from __future__ import annotations

from typing import Any

from agent.common.reader import Problem
from agent.common.wording import printable, show


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
