"""handfast.deploy.analysis.patience: code of others that never returns does not hold up the rest."""

from __future__ import annotations

import threading

import pytest

from handfast.deploy.analysis.patience import answer


def test_what_returns_or_raises_does_so() -> None:
    assert answer("it", lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        answer("it", lambda: 1 // 0)


def test_what_does_not_return_is_not_waited_for() -> None:
    hangs = threading.Event()
    with pytest.raises(TimeoutError, match=r"^modes\(\) did not return within 0.01 s$"):
        answer("modes()", hangs.wait, seconds=0.01)
    hangs.set()
