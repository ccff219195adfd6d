"""Waits for code of others, which may never return, for so long and no longer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, TypeVar

ANSWER_S: Final = 10.0
"""Code of others that takes longer at the start of a fleet is not waited for."""
T = TypeVar("T")


def answer(call: Callable[[], T], seconds: float = ANSWER_S) -> T:
    """What `call` returns or raises. It runs in a thread, which is left behind if it does not end, and does
    not outlive the process.

    Raises:
        TimeoutError: it has not returned within so many seconds.
    """
    found: list[T] = []
    raised: list[BaseException] = []

    def ask() -> None:
        try:
            found.append(call())
        except BaseException as error:  # is raised where it was asked for
            raised.append(error)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    if not found:
        raise TimeoutError
    return found[0]
