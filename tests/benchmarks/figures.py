"""Figures beside their targets, and tables that people read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from math import isfinite
from statistics import median
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One measured number. `limit` is the issue's target; it is shown, never asserted."""

    name: str
    value: float
    unit: str = ""
    limit: float | None = None
    at_most: bool = True
    note: str = ""

    @property
    def met(self) -> bool | None:
        if self.limit is None:
            return None
        return self.value <= self.limit if self.at_most else self.value >= self.limit

    def row(self) -> tuple[str, str, str, str, str]:
        target = "" if self.limit is None else f"{'<=' if self.at_most else '>='} {number(self.limit)}"
        verdict = {None: "", True: "met", False: "MISSED"}[self.met]
        unit = f" {self.unit}" if self.unit else ""
        return (
            self.name,
            f"{number(self.value)}{unit}",
            f"{target}{unit}" if target else "",
            verdict,
            self.note,
        )


@dataclass
class Result:
    """What one benchmark found."""

    figures: list[Figure] = field(default_factory=list)
    details: list[str] = field(default_factory=list)
    """Lines of further tables."""

    def as_dict(self) -> dict[str, Any]:
        figures = [asdict(figure) | {"met": figure.met} for figure in self.figures]
        return {"figures": figures, "details": self.details}


@dataclass(frozen=True)
class Options:
    """How thorough to be."""

    quick: bool = False
    count: int | None = None


def number(value: float) -> str:
    """Three significant digits or so; "-" for what was not to be had (nan, inf)."""
    if not isfinite(value):
        return "-"
    size = abs(value)
    if size >= 100.0 or value == int(value):
        return f"{value:.0f}"
    return f"{value:.1f}" if size >= 10.0 else f"{value:.2f}" if size >= 0.1 else f"{value:.3g}"


def spread(values: Sequence[float]) -> str:
    """Median and range: ``1.32 (1.28 to 1.41)``."""
    return f"{number(median(values))} ({number(min(values))} to {number(max(values))})"


def table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    grid = [list(heading), *map(list, rows)]
    widths = [max(len(row[k]) for row in grid) for k in range(len(heading))]
    lines = []
    for row in grid:
        cells = [
            cell.ljust(w) if k == 0 else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "-" * max(map(len, lines)))
    return lines


def figure_table(figures: Sequence[Figure]) -> list[str]:
    grid = [("figure", "measured", "target", "", ""), *(figure.row() for figure in figures)]
    widths = [max(len(row[k]) for row in grid) for k in range(5)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in grid]
    lines.insert(1, "-" * max(map(len, lines)))
    return lines


def load() -> str:
    return "load average " + " ".join(f"{value:.2f}" for value in os.getloadavg())
