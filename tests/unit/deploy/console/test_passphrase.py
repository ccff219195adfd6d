"""Where a passphrase comes from."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from handfast.deploy.console import passphrase as module
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.passphrase import LENGTH_MIN, PASSPHRASE, passphrase

GOOD = "correct horse battery"


class Terminal:
    def isatty(self) -> bool:
        return True


def typed(monkeypatch: pytest.MonkeyPatch, *texts: str) -> list[str]:
    """Somebody at a terminal types these; what was asked."""
    asked: list[str] = []
    answers: Iterator[str] = iter(texts)

    def getpass(prompt: str) -> str:
        asked.append(prompt)
        answer = next(answers, None)
        if answer is None:
            raise EOFError
        return answer

    monkeypatch.delenv(PASSPHRASE, raising=False)
    monkeypatch.setattr("sys.stdin", Terminal())
    monkeypatch.setattr(module.getpass, "getpass", getpass)
    return asked


def test_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PASSPHRASE, GOOD)
    assert passphrase("it", new=True) == GOOD


def test_a_new_one_is_typed_twice_an_old_one_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = typed(monkeypatch, GOOD, GOOD)
    assert passphrase("it", new=True) == GOOD
    assert len(asked) == 2
    asked = typed(monkeypatch, "short")
    assert passphrase("it", new=False) == "short"
    assert asked == ["Passphrase of it: "]


def test_what_will_not_do(monkeypatch: pytest.MonkeyPatch) -> None:
    typed(monkeypatch, GOOD, "another battery")
    with pytest.raises(InputError, match="the two passphrases are not the same"):
        passphrase("it", new=True)
    typed(monkeypatch, "short", "short")
    with pytest.raises(InputError, match=f"the passphrase of it must have at least {LENGTH_MIN} characters"):
        passphrase("it", new=True)
    typed(monkeypatch)
    with pytest.raises(InputError, match="no passphrase of it was given"):
        passphrase("it", new=False)


def test_without_a_terminal_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PASSPHRASE, raising=False)
    monkeypatch.setattr(Terminal, "isatty", lambda _: False)
    monkeypatch.setattr("sys.stdin", Terminal())
    with pytest.raises(InputError, match=f"it has a passphrase: set {PASSPHRASE}"):
        passphrase("it", new=False)
