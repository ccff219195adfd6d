"""The live view of a fleet: a table on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Protocol, TextIO

from handfast.deploy.analysis.silence import in_words
from handfast.deploy.console.views import LinesView, Speaker
from handfast.deploy.drive.display.picture_wording import REASONS_MAX, faults_line, summary
from handfast.deploy.drive.watch import Picture


class View(Speaker, Protocol):
    """Where progress is shown."""

    def show(self, picture: Picture) -> None:
        """The fleet as it is now."""
        ...


def make_view(stream: TextIO | None = None, *, quiet: bool = False, period_s: float = 2.0) -> View:
    """A live table on a terminal; elsewhere plain lines, one for each `period_s` of fleet time.

    When `quiet`, only what `say` is given.
    """
    stream = sys.stderr if stream is None else stream
    if quiet or not stream.isatty() or find_spec("rich") is None:
        return Lines(stream, quiet=quiet, period_s=period_s)
    from handfast.deploy.drive.display.terminal_view import Terminal  # loads Rich

    return Terminal(stream)


class Lines(LinesView):
    """A line now and then."""

    def __init__(self, stream: TextIO, *, quiet: bool, period_s: float) -> None:
        super().__init__(stream)
        self._quiet, self._period_s = quiet, period_s
        self._due_s = 0.0

    def show(self, picture: Picture) -> None:
        if self._quiet or picture.time_s is None or picture.time_s < self._due_s:
            return
        self._due_s = (picture.time_s // self._period_s + 1.0) * self._period_s
        lines = [summary(picture), *in_words(picture.silent, REASONS_MAX), faults_line(picture)]
        self.say(f"{picture.time_s:6.1f} s  {', '.join(filter(None, lines))}")
