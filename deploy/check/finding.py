"""One thing that the author of a fleet file should know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that the file's author should know.

    Attributes:
        level: error: it would not work; warning: it may not; info: good to know.
        place: field of the fleet file; arrays count from 1 as in `agent.common.reader`.
        message: what is found, its values, and what would be right.
    """

    level: Level
    place: str
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.place}: {self.message}"
