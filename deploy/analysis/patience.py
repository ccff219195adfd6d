"""How long code of others is waited for where a fleet starts, and how much of a period it may take there."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, TypeVar

ANSWER_S: Final = 10.0
"""What takes longer is not waited for."""
SHARE_MAX: Final = 0.25
"""Of a period: the rest is for messages, the safety filter and other processes."""
T = TypeVar("T")


def answer(what: str, call: Callable[[], T], seconds: float | None = None) -> T:
    """What `call` returns or raises. It runs in a thread, which is left behind if it does not end, and does
    not outlive the process. `what` names it in messages.

    Raises:
        TimeoutError: it has not returned within so many seconds, `ANSWER_S` unless given.
    """
    seconds = ANSWER_S if seconds is None else seconds
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
        raise TimeoutError(f"{what} did not return within {seconds:g} s")
    return found[0]
