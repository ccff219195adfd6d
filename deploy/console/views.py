"""How progress is shown: lines for logs and pipes; for terminals `deploy.console.terminal`.

Texts come from robots and hosts: they are made safe to print. Nobody who looks on can hold up what is done:
an output that cannot be written to any more, as a pipe whose reader is gone, is left alone.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Final, Protocol, Self, TextIO

from handfast.agent.common.wording import printable

GONE: Final = (OSError, ValueError)
"""What writing to an output raises that is gone, or closed."""


class Speaker(Protocol):
    """Where lines are shown. A context manager; nothing here raises."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *_: object) -> None: ...
    def say(self, text: str) -> None:
        """One line that stays."""
        ...


class LinesView:
    """Plain lines. A context manager."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def say(self, text: str) -> None:
        with suppress(*GONE):
            print(printable(text), file=self._stream, flush=True)
