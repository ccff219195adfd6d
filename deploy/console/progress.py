"""How far many runs have come: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from typing import Any, Final, TextIO

LINE_PERIOD_S: Final = 10.0


def make_progress(
    stream: TextIO, total: int, done: int = 0, *, quiet: bool, trouble: str, troubled: int = 0
) -> Lines | Bar:
    """Makes what shows progress: a bar on a terminal, else a plain line from time to time. Context managers.

    Args:
        total, done: all runs, and those that were done before.
        trouble: what is wrong with the runs that are counted as such, in words.
        troubled: so many of those that were done before are.
    """
    if stream.isatty() and not quiet:
        return Bar(stream, total, done, trouble, troubled)
    return Lines(stream, total, done, trouble, troubled, quiet=quiet)


class Lines:
    """Plain lines, for logs and pipes: at every tenth of the runs, and every `LINE_PERIOD_S`."""

    def __init__(
        self, stream: TextIO, total: int, done: int, trouble: str, troubled: int, *, quiet: bool
    ) -> None:
        self._stream, self._total, self._done, self._quiet = stream, total, done, quiet
        self._before, self._what, self._trouble = done, trouble, troubled
        self._begun_s = self._told_s = time.monotonic()

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def say(self, text: str) -> None:
        """A line of its own, quiet or not."""
        print(text, file=self._stream, flush=True)

    def add(self, *, trouble: bool) -> None:
        """One more is done."""
        self._done += 1
        self._trouble += trouble
        now_s = time.monotonic()
        tenth = self._done * 10 // self._total > (self._done - 1) * 10 // self._total
        if self._quiet or not (tenth or now_s - self._told_s > LINE_PERIOD_S):
            return
        self._told_s = now_s
        rate = (self._done - self._before) / max(now_s - self._begun_s, 1e-3)
        left_s = (self._total - self._done) / rate
        wrong = f", {self._trouble} {self._what}" if self._trouble else ""
        self.say(f"{self._done} of {self._total} runs, {rate:.2f} a second, {clock(left_s)} left{wrong}")


def clock(seconds: float) -> str:
    """A duration (s) as h:mm:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


class Bar:
    """A bar that is redrawn in place."""

    def __init__(self, stream: TextIO, total: int, done: int, trouble: str, troubled: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._progress = Progress(
            TextColumn("[bold]driving"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("left"),
            TextColumn("{task.fields[trouble]}"),
            console=Console(file=stream),
            speed_estimate_period=120.0,
        )
        self._before, self._done, self._what, self._trouble = done, done, trouble, troubled
        self._task = self._progress.add_task("", total=total, completed=done, rate="", trouble="")

    def __enter__(self) -> Bar:
        self._begun_s = time.monotonic()
        self._progress.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._progress.__exit__(*error)

    def say(self, text: str) -> None:
        """A line of its own, above the bar."""
        self._progress.console.print(text, markup=False, highlight=False)

    def add(self, *, trouble: bool) -> None:
        """One more is done."""
        self._done += 1
        self._trouble += trouble
        rate = (self._done - self._before) / max(time.monotonic() - self._begun_s, 1e-3)
        wrong = f"{self._trouble} {self._what}" if self._trouble else ""
        self._progress.update(self._task, completed=self._done, rate=f"{rate:.2f}/s", trouble=wrong)
