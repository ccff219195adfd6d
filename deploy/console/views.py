"""How progress is shown: lines for logs and pipes, and what is redrawn in place on a terminal.

Texts come from robots and hosts: they are made safe to print. Nobody who looks on can hold up what is done:
an output that cannot be written to any more, as a pipe whose reader is gone, is left alone.
"""

from __future__ import annotations

import termios
from contextlib import suppress
from types import TracebackType
from typing import Any, Protocol, Self, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from agent.common.wording import printable

_DEAD = (OSError, ValueError)
"""What writing to an output raises that is gone, or closed."""


class Speaker(Protocol):
    """Where lines are shown. A context manager; nothing here raises."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def say(self, text: str) -> None:
        """One line that stays."""
        ...


class LinesView:
    """Plain lines. A context manager."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def say(self, text: str) -> None:
        with suppress(*_DEAD):
            print(printable(text), file=self._stream, flush=True)


class TerminalView:
    """What is redrawn in place, with lines above it, and stays at the end. A context manager."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        # As long as nothing is drawn: else an empty line would stay.
        self._live = Live(console=_Screen(file=stream), auto_refresh=False, transient=True)
        self._settings: list[Any] | None = None

    def __enter__(self) -> Self:
        # A Ctrl-C that the terminal echoes as ^C would shift what is redrawn from where it is; and it would
        # drop what was written and is not shown yet, so that pieces stayed.
        with suppress(termios.error, *_DEAD):
            settings = termios.tcgetattr(self._stream.fileno())
            quiet = list(settings)
            quiet[3] = quiet[3] & ~termios.ECHOCTL | termios.NOFLSH
            termios.tcsetattr(self._stream.fileno(), termios.TCSANOW, quiet)
            self._settings = settings
        with suppress(*_DEAD):
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(*_DEAD):
            last = self._last()
            if last is not None:
                self._live.update(last)  # drawn once, as it stops
            self._live.stop()
        if self._settings is not None:
            with suppress(termios.error, *_DEAD):
                termios.tcsetattr(self._stream.fileno(), termios.TCSANOW, self._settings)

    def say(self, text: str) -> None:
        with suppress(*_DEAD):
            self._live.console.print(plain(text), soft_wrap=True)

    @property
    def _height(self) -> int:
        """Lines of the terminal."""
        return self._live.console.height

    def _last(self) -> RenderableType | None:
        """What stays at the end; None for what was drawn last."""
        return None

    def _draw(self, what: RenderableType) -> None:
        self._live.transient = False
        with suppress(*_DEAD):
            self._live.update(what, refresh=True)


class _Screen(Console):
    def on_broken_pipe(self) -> None:
        """Nobody is there to read: nothing more is written. Rich's own would end the program."""
        self.quiet = True


def plain(text: str, style: str = "") -> Text:
    """The text itself in a table, whatever is in it: no markup, no control characters."""
    return Text(printable(text), style=style)
