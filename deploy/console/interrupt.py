"""Ctrl-C and its like, as something to look at instead of an exception."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

NOT_STARTED: Final = "nothing was started"
"""The answer while a command still reads what it was given, which may take for ever (a pipe)."""
_unanswered: Final[list[int]] = []
"""Interrupts that were raised within `remembered`."""


def _raise(number: int, _frame: object) -> None:
    _unanswered.append(number)
    raise KeyboardInterrupt


@contextmanager
def remembered() -> Iterator[None]:
    """A context in which Ctrl-C raises KeyboardInterrupt, as usual, and is remembered if it is swallowed.

    A module that is being loaded may swallow it, and the command would go on: `Interrupt.caught` raises it
    once more.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield  # ignored, by who started this process, or not this function's to answer
        return
    _unanswered.clear()
    signal.signal(signal.SIGINT, _raise)
    try:
        yield
    except RuntimeError as error:
        # What `__set_name__` raises Python 3.11 wraps: a class of settings was being made.
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise error.__cause__ from None
        raise
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _unanswered.clear()


@contextmanager
def as_python_does() -> Iterator[None]:
    """A context in which Ctrl-C is answered as Python does by itself.

    Only then does `asyncio.run` cancel what it runs. Raised in the midst of a task, an interrupt would leave
    the others behind.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is not _raise:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class Interrupt:
    """Counts Ctrl-C (and SIGTERM, SIGHUP) instead of raising: a run is ended in order."""

    def __init__(self) -> None:
        self.count = 0
        self.number = 0
        self._answer = ""
        self._raises = False

    def _on_signal(self, number: int, _frame: object) -> None:
        self.count += 1
        self.number = number
        if self._answer:
            # Past `sys.stderr`, in the midst of whose own writing this may come.
            with suppress(OSError, ValueError, AttributeError):  # there may be none
                line = f"{signal.Signals(number).name}: {self._answer}\n"
                os.write(sys.stderr.fileno(), line.encode(errors="replace"))
        if self._raises:
            raise KeyboardInterrupt

    @contextmanager
    def answered(self, text: str, *, raises: bool = False) -> Iterator[None]:
        """Meanwhile each is answered at once, with what is being done about it.

        Args:
            raises: each also raises KeyboardInterrupt, where what is under way may be broken off.

        Raises:
            KeyboardInterrupt: at the end, where one was swallowed: of what is raised while an object is
                finalized, as that may be at any time, Python only prints a traceback.
        """
        before, hook = self.count, sys.unraisablehook
        self._answer, self._raises = text, raises
        if raises:
            sys.unraisablehook = lambda what: None if what.exc_type is KeyboardInterrupt else hook(what)
        try:
            yield
            if raises and self.count > before:
                raise KeyboardInterrupt
        finally:
            self._answer, self._raises = "", False
            sys.unraisablehook = hook

    @contextmanager
    def caught(self) -> Iterator[Interrupt]:
        """Counts from here on. In another thread than the main one it hears of nothing.

        Raises:
            KeyboardInterrupt: there was one before, which was swallowed (`remembered`).
        """
        is_main = threading.current_thread() is threading.main_thread()
        numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP] if is_main else []
        if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # of `nohup`: it goes on without its terminal
            numbers = numbers[:-1]
        before = {number: signal.signal(number, self._on_signal) for number in numbers}
        try:
            if _unanswered:
                raise KeyboardInterrupt
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
