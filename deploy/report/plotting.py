"""What all pictures share: colours, style, and how a figure is made and written.

By matplotlib's object interface, without global state, always the same bytes. Colours are Okabe and Ito's,
which colour-blind readers tell apart.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle as RoundPatch
from matplotlib.patches import Patch
from matplotlib.patches import Polygon as CornerPatch

from agent.control.boundaries import Circle, Polygon
from agent.formation.points import Floats
from deploy.recording.recorder import RecordingError

PALETTE: Final = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#4D4D4D",
)  # fmt: skip
INK: Final = "#222222"
GREY: Final = "#8A8A8A"
RED: Final = "#C1121F"
DPI: Final = 150
LEGEND_MAX: Final = 10
"""More lines than this have no legend and are drawn thin."""

DOTTED: Final = (0, (1, 2))
_SECOND_ROUND: Final = (0, (3, 1, 1, 1))

STYLE: Final[dict[str, Any]] = {
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "text.color": INK,
}


@contextmanager
def styled() -> Iterator[None]:
    """A context in which figures look like a report's, whatever a user's own matplotlibrc says."""
    with mpl.rc_context():
        mpl.rcdefaults()
        settings: Any = mpl.rcParams  # its type names every key there is in one version of matplotlib
        settings.update(STYLE)
        yield


def write(path: Path, draw: Callable[[], Figure]) -> None:
    """Draw and write one picture (PNG).

    Raises:
        RecordingError: when it cannot be written.
    """
    with styled():
        figure = draw()
        try:
            # No software version and no date in the file: the same run gives the same bytes.
            figure.savefig(path, dpi=DPI, format="png", metadata={"Software": None})
        except OSError as error:
            raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error


class Picture(Figure):
    """A figure that shows itself in a notebook, whether pyplot is loaded there or not."""

    def _repr_png_(self) -> bytes:
        out = BytesIO()
        self.savefig(out, format="png")
        return out.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches."""
    figure = Picture(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def nth_color(index: int) -> str:
    """A colour of the palette, over again from its start when there are more lines than colours."""
    return PALETTE[index % len(PALETTE)]


def nth_line(index: int) -> dict[str, Any]:
    """Colour and dashes of a line: over again there are other dashes."""
    return {"color": nth_color(index), "linestyle": "solid" if index < len(PALETTE) else _SECOND_ROUND}


def note(axes: Axes, text: str) -> None:
    """Say why there is nothing to see."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=GREY)


# --- what stands in the way ----------------------------------------------------------------------

_OBSTACLE: Final = "#D3D3D3"
DASHED: Final = (0, (6, 3))


def view(low: Floats, high: Floats, ground: Sequence[Circle | Polygon]) -> tuple[Floats, Floats]:
    """Corners (x, y) of the ground to show: all paths, from `low` to `high`, and what lies by them.

    An obstacle half as far away as the paths are wide, or a fence as far away, would only make them small.
    """
    span = max(float((high - low).max()), 0.5)
    shown_low, shown_high = low, high
    for boundary in ground:
        least, most = _box(boundary)
        is_fence = isinstance(boundary, Polygon) and boundary.inside
        reach = span if is_fence else 0.5 * span
        is_by = (least > low - reach).all() and (most < high + reach).all()
        if is_by:
            shown_low, shown_high = np.minimum(shown_low, least), np.maximum(shown_high, most)
    return shown_low, shown_high


def _box(boundary: Circle | Polygon) -> tuple[Floats, Floats]:
    if isinstance(boundary, Circle):
        centre = np.array([boundary.x, boundary.y])
        return centre - boundary.radius, centre + boundary.radius
    points = np.array(boundary.points)
    return points.min(axis=0), points.max(axis=0)


def draw_boundary(axes: Axes, boundary: Circle | Polygon) -> None:
    """An obstacle as a grey area with its name, a fence as a dashed line."""
    if isinstance(boundary, Polygon) and boundary.inside:
        axes.add_patch(
            CornerPatch(
                boundary.points, fill=False, edgecolor=RED, linewidth=1.1, linestyle=DASHED, zorder=1.6
            )
        )
        return
    patch: Patch
    if isinstance(boundary, Circle):
        patch = RoundPatch((boundary.x, boundary.y), boundary.radius)
        top = boundary.x, boundary.y + boundary.radius
    else:
        patch = CornerPatch(boundary.points)
        points = np.array(boundary.points)
        x, y = points[points[:, 1] == points[:, 1].max()].mean(axis=0).tolist()
        top = x, y
    patch.set(facecolor=_OBSTACLE, edgecolor=GREY, linewidth=0.8, zorder=1.5)
    axes.add_patch(patch)
    axes.annotate(
        boundary.name, top, xytext=(0, 2), textcoords="offset points", ha="center", va="bottom",
        fontsize=7, color=INK, zorder=9, annotation_clip=True, parse_math=False,
        bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.6},
    )  # fmt: skip


def draw_many(axes: Axes, t: Floats, values: Floats, what: str) -> None:
    """Many lines over the same times: thin ones, their envelope and their median. values: (k, m)."""
    known = values[:, np.isfinite(values).any(axis=0)]
    if not known.shape[1]:
        return
    least, greatest = np.fmin.reduce(known, axis=1), np.fmax.reduce(known, axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # there may be times without any: no line there
        median = np.nanmedian(known, axis=1)
    color = PALETTE[0]
    axes.fill_between(t, least, greatest, color=color, alpha=0.10, linewidth=0)
    segments = [np.column_stack([t, known[:, index]]) for index in range(known.shape[1])]
    axes.add_collection(LineCollection(segments, colors=color, linewidths=0.4, alpha=0.35))
    axes.plot(t, least, color=color, linewidth=0.9)
    label = f"least and greatest of {known.shape[1]} {what}s"
    axes.plot(t, greatest, color=color, linewidth=0.9, label=label)
    axes.plot(t, median, color=INK, linewidth=1.3, label="median")
