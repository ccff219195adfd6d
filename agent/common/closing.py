"""The base of context managers that are closed when they are left."""

from __future__ import annotations

from typing import Self


class Closing:
    """A context manager that is entered as it is, and closed when it is left."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back what it holds."""
        raise NotImplementedError
