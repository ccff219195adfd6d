"""The pictures of a sweep: heat maps over two fields, curves over one, the same bytes for the same rows.

Colours are cividis's (Nuñez, Anderton, Renslow 2018), which colour-blind readers see as others do;
every cell has its value written in it, and what has no value is hatched and says why.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from math import ceil
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from handfast.agent.formation.points import Floats
from handfast.deploy.report.plotting import INK, PALETTE, RED, new_figure, write
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.sweep.summary import CLOSEST, QUANTILES, SETTLING, Cell, Margin, Shown, shown
from handfast.deploy.sweep.varied import Axis

PANELS_MAX: Final = 12
"""Combinations of the third and further fields that are drawn."""
LABEL_MAX: Final = 18
CURVES: Final = "curves"
_MAP: Final = "cividis"
_HATCHED: Final = "#EDEDED"
_MARGIN: Final = RED


@dataclass(frozen=True, slots=True)
class HeatMap:
    """What a heat map shows of each cell: its number, the text in the cell, and what it says without one."""

    name: str
    title: str
    value: Callable[[Cell], float | None]
    text: Callable[[Cell, float], str]
    nothing: Callable[[Cell], str]
    limits: tuple[float, float] | None = None
    low_is_good: bool = True


_SHARE_SAFE: Final = HeatMap(
    "share_safe", "Share of runs that were safe (%)", lambda cell: 100.0 * cell.safe.share,
    lambda cell, _: f"{100.0 * cell.safe.share:.0f} %\n{cell.safe.count}/{cell.safe.of}", lambda _: "",
    limits=(0.0, 100.0), low_is_good=False,
)  # fmt: skip


def _heat_map(one: Shown) -> HeatMap:
    title = (
        "Closest that robots came in any run" if one.name == CLOSEST else f"{one.title}, median of all runs"
    )
    return HeatMap(
        one.picture.file, f"{title} ({one.picture.unit})", one.value,
        lambda cell, value: one.text(value) + _remark(one.name, cell, value),
        lambda cell: _nothing(one.name, cell), low_is_good=one.low_is_good,
    )  # fmt: skip


def _remark(name: str, cell: Cell, value: float) -> str:
    if name == SETTLING and cell.settled.count < cell.settled.of:
        return f"\n{cell.settled.count}/{cell.settled.of}"
    return "\nunsafe" if name == CLOSEST and value < cell.safe_distance_m else ""


def _nothing(name: str, cell: Cell) -> str:
    if name != SETTLING or cell.unfinished == cell.runs:
        return "not\nfinished"
    return f"{cell.settled.count}/{cell.settled.of}\nsettled" if cell.settled.count else "not\nsettled"


def write_sweep_figures(
    folder: Path,
    plan: Plan,
    cells: Sequence[Cell],
    margin: int | None,
    found: Sequence[Margin],
) -> tuple[list[Path], str]:
    """Draws the sweep into `folder`: PNGs, and a sentence on what they leave out (mostly empty).

    `margin` is the axis whose margin is `found`. A sweep that varies nothing has no pictures.

    Raises:
        RecordingError: one cannot be written.
    """
    paths = []
    for name, draw in drawings(plan, cells, margin, found).items():
        paths.append(folder / f"{name}.png")
        write(paths[-1], draw)
    grid = _Grid(plan, margin) if len(plan.axes) > 2 else None
    if grid is None or len(grid.all_panels) <= PANELS_MAX:
        return paths, ""
    names = ", ".join(plan.axes[k].field for k in grid.rest)
    return paths, (
        f"the pictures show {PANELS_MAX} of {len(grid.all_panels)} combinations of {names}; all are in "
        "summary.csv"
    )


def drawings(
    plan: Plan,
    cells: Sequence[Cell],
    margin: int | None,
    found: Sequence[Margin],
) -> dict[str, Callable[[], Figure]]:
    """What makes each picture of a sweep, by its name; arguments as `write_sweep_figures`'s."""
    if not plan.axes:
        return {}
    if len(plan.axes) == 1:
        return {CURVES: partial(curves, plan, cells, found)}
    grid = _Grid(plan, margin)
    return {
        each.name: partial(heat_maps, each, grid, cells, found)
        for each in (*map(_heat_map, shown()), _SHARE_SAFE)
    }


# --- two fields and more: heat maps -----------------------------------------------------------


class _Grid:
    """Which axis goes where: the margin's across, the next one up, the rest over panels."""

    def __init__(self, plan: Plan, margin: int | None) -> None:
        self.plan = plan
        self.across = margin if margin is not None else 0
        others = [k for k in range(len(plan.axes)) if k != self.across]
        others.sort(key=lambda k: len(plan.axes[k].values) == 1)  # what does not vary needs no room
        self.up, self.rest = others[0], others[1:]
        self.margin = margin
        self.all_panels = list(product(*(range(len(plan.axes[k].values)) for k in self.rest)))

    @property
    def panels(self) -> list[tuple[int, ...]]:
        return self.all_panels[:PANELS_MAX]

    @property
    def x(self) -> Axis:
        return self.plan.axes[self.across]

    @property
    def y(self) -> Axis:
        return self.plan.axes[self.up]

    def title(self, panel: tuple[int, ...]) -> str:
        axes = [self.plan.axes[k] for k in self.rest]
        return ", ".join(
            f"{axis.field} = {short(axis.values[place])}" for axis, place in zip(axes, panel, strict=True)
        )

    def cell(self, column: int, row: int, panel: tuple[int, ...]) -> int:
        """Number of a cell from its places."""
        places = dict(zip(self.rest, panel, strict=True)) | {self.across: column, self.up: row}
        number = 0
        for k, axis in enumerate(self.plan.axes):
            number = number * len(axis.values) + places[k]
        return number


def heat_maps(what: HeatMap, grid: _Grid, cells: Sequence[Cell], found: Sequence[Margin]) -> Figure:
    """One quantity over two fields, a panel for each combination of the others."""
    columns_in, rows_in = len(grid.x.values), len(grid.y.values)
    panels = grid.panels
    across = min(len(panels), max(1, round(11.0 / (0.72 * columns_in + 1.0))), 4)
    down = ceil(len(panels) / across)
    width = max(0.72, 3.4 / columns_in / across) * columns_in
    height = max(0.52, 1.6 / rows_in) * rows_in
    figure = new_figure(across * (width + 0.45) + 1.7, down * (height + 0.5) + 1.1)
    axes_grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    values = [what.value(cells[number]) for number in _drawn(grid)]
    known = [value for value in values if value is not None]
    low, high = what.limits or ((min(known), max(known)) if known else (0.0, 1.0))
    norm = Normalize(low, high if high > low else low + max(abs(low), 1.0))
    # Bright is good in every picture.
    colors = mpl.colormaps[_MAP + ("_r" if what.low_is_good else "")]
    for index, axes in enumerate(axes_grid.flat):
        if index >= len(panels):
            axes.set_visible(False)
            continue
        _draw_panel(axes, what, grid, panels[index], cells, norm, colors)
        if grid.margin is not None:
            _draw_margin(axes, grid, panels[index], found)
        if grid.rest:
            axes.set_title(grid.title(panels[index]), fontsize=8.5, fontweight="normal")
        if index % across == 0:
            axes.set_ylabel(_label(grid.y))
        if index + across >= len(panels):
            axes.set_xlabel(_label(grid.x))
            axes.tick_params(labelbottom=True)
    figure.suptitle(what.title, x=0.01, ha="left", fontsize=9.5, fontweight="bold")
    if grid.margin is not None:
        note = "left of the red line every run was safe and settled"
        figure.supxlabel(note, x=0.01, ha="left", fontsize=8.0, color=RED)
    if known:
        aspect = figure.get_figheight() / 0.16  # as thick in every figure
        bar = figure.colorbar(ScalarMappable(norm, colors), ax=axes_grid, aspect=aspect, pad=0.02)
        bar.outline.set_visible(False)
    return figure


def _drawn(grid: _Grid) -> list[int]:
    return [
        grid.cell(column, row, panel)
        for panel in grid.panels
        for row in range(len(grid.y.values))
        for column in range(len(grid.x.values))
    ]


def _draw_panel(
    axes: Axes,
    what: HeatMap,
    grid: _Grid,
    panel: tuple[int, ...],
    cells: Sequence[Cell],
    norm: Normalize,
    colors: Any,
) -> None:
    columns, rows = len(grid.x.values), len(grid.y.values)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(-0.5, rows - 0.5)
    axes.grid(False)
    axes.set_xticks(range(columns), [short(value) for value in grid.x.values])
    axes.set_yticks(range(rows), [short(value) for value in grid.y.values])
    axes.tick_params(length=0)
    if sum(len(short(value)) + 1 for value in grid.x.values) > 9 * columns:
        axes.tick_params(axis="x", labelrotation=30)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for column, row in product(range(columns), range(rows)):
        cell = cells[grid.cell(column, row, panel)]
        value = what.value(cell)
        if value is None:
            face, ink, text = _HATCHED, INK, what.nothing(cell)
        else:
            face = colors(norm(value))
            ink = "white" if float(np.dot(face[:3], (0.299, 0.587, 0.114))) < 0.5 else INK
            text = what.text(cell, value)
        axes.add_patch(
            Rectangle(
                (column - 0.5, row - 0.5), 1.0, 1.0, facecolor=face, linewidth=1.0,
                edgecolor="#BDBDBD" if value is None else "white", hatch="///" if value is None else None,
            )
        )  # fmt: skip
        axes.text(
            column, row, text, ha="center", va="center", fontsize=7.5, color=ink, linespacing=1.1,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": _HATCHED, "edgecolor": "none"}
            if value is None else None,
        )  # fmt: skip


def _draw_margin(axes: Axes, grid: _Grid, panel: tuple[int, ...], found: Sequence[Margin]) -> None:
    """A line between what was safe and settled in every run (left) and what was not."""
    fixed = [
        (grid.plan.axes[k].field, grid.plan.axes[k].values[p]) for k, p in zip(grid.rest, panel, strict=True)
    ]
    xs: list[float] = []
    ys: list[float] = []
    for row, value in enumerate(grid.y.values):
        wanted = {*fixed, (grid.y.field, value)}
        good = next(margin.good for margin in found if set(margin.others) == wanted)
        xs += [good - 0.5, good - 0.5]
        ys += [row - 0.5, row + 0.5]
    axes.plot(xs, ys, color="white", linewidth=4.0, zorder=5, clip_on=False, solid_joinstyle="miter")
    axes.plot(xs, ys, color=_MARGIN, linewidth=2.2, zorder=6, clip_on=False, solid_joinstyle="miter")


def short(value: str) -> str:
    """A value as a label: without quotes, cut where it is long."""
    text = value.strip("\"'")
    return text if len(text) <= LABEL_MAX else text[: LABEL_MAX - 1] + "…"


def _label(axis: Axis) -> str:
    bare = axis.unit and all(value[-1:].isdigit() or value[-1:] == "." for value in axis.values)
    return f"{axis.field} ({axis.unit})" if bare else axis.field


# --- one field: curves ------------------------------------------------------------------------


def curves(plan: Plan, cells: Sequence[Cell], found: Sequence[Margin]) -> Figure:
    """What is shown over the only field: medians with the quartiles as a band; last, shares of good runs."""
    (axis,) = plan.axes
    x = np.array(axis.numbers if axis.numbers is not None else range(len(axis.values)), dtype=np.float64)
    each = shown()
    rows = len(each) // 2 + 1
    figure = new_figure(8.6, 2.9 * rows)
    panels = figure.subplots(rows, 2, sharex=True)
    for axes, one in zip(panels.flat, each, strict=False):
        _draw_curve(axes, axis, x, cells, one, few=plan.repeat == 1)
    safe = panels.flat[len(each)]
    for axes in panels.flat[len(each) + 1 :]:
        axes.set_visible(False)
    _draw_shares(safe, axis, x, cells)
    for axes in panels.flat[len(each) - 1 : len(each) + 1]:  # below them is none
        axes.set_xlabel(_unit_label(axis))
        axes.tick_params(labelbottom=True)
    if axis.numbers is None:
        safe.set_xlim(-0.5, len(x) - 0.5)
        for axes in panels.flat:
            axes.set_xticks(x, [short(value) for value in axis.values], rotation=30 if len(x) > 5 else 0)
    for margin in found:
        if margin.largest is not None and margin.failed is not None:
            for axes in panels.flat:
                axes.axvspan(x[margin.good - 1], x[margin.good], color=_MARGIN, alpha=0.10, linewidth=0)
            title = f"margin between {margin.largest} and {margin.failed} (red)"
            figure.suptitle(title, x=0.99, ha="right", fontsize=8.0)
    return figure


def _draw_shares(safe: Axes, axis: Axis, x: Floats, cells: Sequence[Cell]) -> None:
    """Draw the shares of runs that were safe and that settled, with their intervals."""
    aside = 0.06 if axis.numbers is None else 0.0  # bars must not lie on each other
    for name, shares, color, moved in (
        ("safe", [cell.safe for cell in cells], PALETTE[0], -aside),
        ("settled", [cell.settled for cell in cells], PALETTE[1], aside),
    ):
        low, high = np.array([share.interval for share in shares]).T
        share = np.array([each.share for each in shares])
        _line(safe, axis, x + moved, (100 * low, 100 * share, 100 * high), color, name)
    safe.set_title("Share of runs, with 95 % interval")
    safe.set_ylabel("share (%)")
    safe.set_ylim(0.0, 104.0)
    safe.legend(loc="best")


def _draw_curve(axes: Axes, axis: Axis, x: Floats, cells: Sequence[Cell], one: Shown, *, few: bool) -> None:
    """The quartiles of one number over the field; with `few` runs there are none."""
    picture = one.picture
    low, middle, high = (
        picture.scale * _floats([cell.quantiles[one.name][label] for cell in cells]) for label in QUANTILES
    )
    _line(axes, axis, x, (low, middle, high), PALETTE[0])
    axes.set_title(f"{one.title}, median and quartiles" if not few else one.title)
    axes.set_ylabel(f"{picture.label} ({picture.unit})")
    if one.name == SETTLING:
        _note_unsettled(axes, x, cells)
    elif one.name == CLOSEST:
        axes.set_title("Closest that robots came")
        least = _floats([cell.least_m for cell in cells])
        axes.plot(x, least, "v", color=INK, markersize=4, label="least of all")
        axes.plot(
            x, [cell.safe_distance_m for cell in cells], color=RED, linewidth=1.2, linestyle=(0, (5, 3)),
            label="safe distance",
        )  # fmt: skip
        axes.legend(loc="best")
    axes.set_ylim(bottom=0.0)


def _note_unsettled(axes: Axes, x: Floats, cells: Sequence[Cell]) -> None:
    """How many runs settled, where not all did."""
    lacking = [
        (place, cell.settled) for place, cell in zip(x, cells, strict=True) if cell.settled.count < cell.runs
    ]
    for place, settled in lacking:
        text = f"{settled.count}/{settled.of}" if settled.count else "none"
        axes.annotate(
            text, (place, 1.0), xycoords=("data", "axes fraction"), xytext=(0, -2),
            textcoords="offset points", ha="center", va="top", fontsize=7.5, color=RED,
        )  # fmt: skip
    if lacking:
        axes.plot([], [], " ", label="red: runs that settled")
        axes.legend(loc="lower right", handlelength=0.0)


def _line(
    axes: Axes, axis: Axis, x: Floats, spread: tuple[Floats, Floats, Floats], color: str, label: str = ""
) -> None:
    """A line within its band; where the axis has no order, points with bars."""
    low, middle, high = spread
    if axis.numbers is None:
        bars = np.nan_to_num(np.array([middle - low, high - middle]))
        axes.errorbar(
            x, middle, bars, fmt="o", color=color, markersize=4, capsize=3, linewidth=1.0, label=label
        )
        return
    axes.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
    axes.plot(x, middle, "o-", color=color, linewidth=1.5, markersize=4, label=label)


def _floats(values: Sequence[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values])


def _unit_label(axis: Axis) -> str:
    return f"{axis.field} ({axis.unit})" if axis.unit and axis.numbers is not None else axis.field
