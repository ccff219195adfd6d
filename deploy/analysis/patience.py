"""Time limits for code of plugins: at the start of a fleet, and within a period."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, TypeVar

ANSWER_S: Final = 10.0
"""Timeout of a call into a plugin, s."""
SHARE_MAX: Final = 0.25
"""Maximum share of a period for a plugin. Messages, the safety filter and other processes need the rest."""
T = TypeVar("T")


def answer(what: str, call: Callable[[], T], seconds: float | None = None) -> T:
    """Run `call` in a thread, and return or raise what it does. `what` names it in messages.

    A thread that does not end in time is abandoned. It is a daemon thread, so it ends with the process.

    Raises:
        TimeoutError: `call` did not return within `seconds`; `ANSWER_S` unless given.
    """
    seconds = ANSWER_S if seconds is None else seconds
    found: list[T] = []
    raised: list[BaseException] = []

    def ask() -> None:
        try:
            found.append(call())
        except BaseException as error:  # raised again in the caller's thread
            raised.append(error)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    if not found:
        raise TimeoutError(f"{what} did not return within {seconds:g} s")
    return found[0]
