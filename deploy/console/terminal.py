"""What is redrawn in place on a terminal; loads Rich, so only who draws imports it."""

from __future__ import annotations

import termios
from contextlib import suppress
from typing import Any, Self, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from handfast.agent.common.wording import printable
from handfast.deploy.console.views import GONE


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
        with suppress(termios.error, *GONE):
            settings = termios.tcgetattr(self._stream.fileno())
            quiet = list(settings)
            quiet[3] = quiet[3] & ~termios.ECHOCTL | termios.NOFLSH
            termios.tcsetattr(self._stream.fileno(), termios.TCSANOW, quiet)
            self._settings = settings
        with suppress(*GONE):
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(*GONE):
            last = self._last()
            if last is not None:
                self._live.update(last)  # drawn once, as it stops
            self._live.stop()
        if self._settings is not None:
            with suppress(termios.error, *GONE):
                termios.tcsetattr(self._stream.fileno(), termios.TCSANOW, self._settings)

    def say(self, text: str) -> None:
        with suppress(*GONE):
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
        with suppress(*GONE):
            self._live.update(what, refresh=True)


class _Screen(Console):
    def on_broken_pipe(self) -> None:
        """Nobody is there to read: nothing more is written. Rich's own would end the program."""
        self.quiet = True


def plain(text: str, style: str = "") -> Text:
    """The text itself in a table, whatever is in it: no markup, no control characters."""
    return Text(printable(text), style=style)
