"""Style and output of all figures: colours, markers, fonts, files; and forks that draw them in parallel.

Figures use matplotlib's object interface without global state, and their bytes are reproducible. The colours
are those of Okabe and Ito, which colour-blind readers can tell apart; markers and dashes tell lines apart
without colour.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from math import cos, sin
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine
from matplotlib.patches import Circle as RoundPatch
from matplotlib.patches import Patch
from matplotlib.patches import Polygon as CornerPatch

from handfast.agent.control.boundaries import Circle, Polygon
from handfast.agent.formation.points import Floats
from handfast.deploy.recording.run_files import RecordingError

PALETTE: Final = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#4D4D4D",
)  # fmt: skip
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h")
"""More than there are colours, and none a multiple of the other: both together come again late."""
INK: Final = "#222222"
GREY: Final = "#8A8A8A"
RED: Final = "#C1121F"
DPI: Final = 150
LEGEND_MAX: Final = 10
"""More lines than this have no legend and are drawn thin."""

DOTTED: Final = (0, (1, 2))
_SECOND_ROUND: Final = (0, (3, 1, 1, 1))
_MARKS: Final = 7
"""Markers on a line."""

STYLE: Final[dict[str, Any]] = {
    "font.family": ["DejaVu Sans"],  # of matplotlib: no machine's other fonts are looked for
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # where it always is here: matplotlib measures all ticks again to find that
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
    "pdf.fonttype": 42,  # TrueType: text that can be searched and edited; journals refuse type 3
    "svg.fonttype": "none",  # text as text
    "svg.hashsalt": "handfast",  # names inside the file come from this, not from chance
}
# No software version and no date in a file: the same run gives the same bytes.
_METADATA: Final[Mapping[str, Mapping[str, None]]] = {
    "png": {"Software": None},
    "svg": {"Creator": None, "Date": None, "Format": None, "Type": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
}
_PNG: Final[Mapping[str, Any]] = {"pil_kwargs": {"compress_level": 3}}
"""In half the time of its usual 6 a file is 7 % larger."""


@contextmanager
def styled() -> Iterator[None]:
    """A context in which figures look like a report's, whatever a user's own matplotlibrc says."""
    with mpl.rc_context():
        mpl.rcdefaults()
        settings: Any = mpl.rcParams  # its type names every key there is in one version of matplotlib
        settings.update(STYLE)
        yield


def write(path: Path, draw: Callable[[], Figure], also: Sequence[Path] = ()) -> None:
    """Draw one picture, once, and write it: PNG, SVG or PDF, by the suffix of each path.

    Raises:
        RecordingError: when it cannot be written.
    """
    with styled():
        figure = draw()
        _lay_out(figure)
        for each in (path, *also):
            kind = each.suffix.removeprefix(".")
            more = _PNG if kind == "png" else {}
            try:
                figure.savefig(each, dpi=DPI, format=kind, metadata=dict(_METADATA[kind]), **more)
            except OSError as error:
                raise RecordingError(f"cannot write {each}: {error.strerror or error}") from error


def _lay_out(figure: Figure) -> None:
    """Gives all on a figure its place, for good: with a layout engine, be it "none", matplotlib would draw it
    twice for each format, once unseen."""
    engine = figure.get_layout_engine()
    if engine is not None and figure.axes:
        figure.set_dpi(DPI)
        engine.execute(figure)
    figure.set_layout_engine(None)


class Picture(Figure):
    """A figure that shows itself in a notebook, whether pyplot is loaded there or not."""

    def _repr_png_(self) -> bytes:
        out = BytesIO()
        self.savefig(out, format="png")
        return out.getvalue()


def new_figure(width: float, height: float, layout: LayoutEngine | None = None) -> Figure:
    """An empty figure, inches; its layout is matplotlib's "constrained" unless another is given."""
    figure = Picture(figsize=(width, height), layout=layout or "constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def nth_color(index: int) -> str:
    """A colour of the palette, over again from its start when there are more lines than colours."""
    return PALETTE[index % len(PALETTE)]


def nth_line(index: int) -> dict[str, Any]:
    """Colour and dashes of a line: over again there are other dashes."""
    return {"color": nth_color(index), "linestyle": "solid" if index < len(PALETTE) else _SECOND_ROUND}


def nth_marker(index: int) -> str:
    """A marker of `MARKERS`, over again from their start."""
    return MARKERS[index % len(MARKERS)]


def nth_marked(index: int, points: int) -> dict[str, Any]:
    """As `nth_line`, for a line of so many points, with a few markers: not where those of its neighbours in
    order are, as lines may lie on each other."""
    every = max(points // _MARKS, 1)
    first = round(every * (0.5 + 0.618 * index) % every)  # by the golden ratio: apart for any number of lines
    return {
        **nth_line(index), "marker": nth_marker(index), "markersize": 4.5, "markeredgewidth": 0.0,
        "markevery": (min(first, points - 1), every),
    }  # fmt: skip


def body_arrow(hand: Floats, heading: float, hand_offset_m: float, size_m: float) -> Floats:
    """Corners (4, 2) m, W, of an arrow at a heading (rad); its tip is the hand point, or its end is where
    that is behind the axle. NaN where one of the two is not known."""
    corners = size_m * np.array([(0.0, 0.0), (-1.6, 0.6), (-1.2, 0.0), (-1.6, -0.6)])
    if hand_offset_m < 0.0:
        corners[:, 0] += 1.6 * size_m
    turned = np.array([[cos(heading), sin(heading)], [-sin(heading), cos(heading)]])
    placed: Floats = hand + corners @ turned
    return placed


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


def top_of(boundary: Circle | Polygon) -> tuple[float, float]:
    """Where the name of an obstacle stands: above this point (x, y) m."""
    if isinstance(boundary, Circle):
        return boundary.x, boundary.y + boundary.radius
    points = np.array(boundary.points)
    x, y = points[points[:, 1] == points[:, 1].max()].mean(axis=0).tolist()
    return x, y


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
    else:
        patch = CornerPatch(boundary.points)
    patch.set(facecolor=_OBSTACLE, edgecolor=GREY, linewidth=0.8, zorder=1.5)
    axes.add_patch(patch)
    axes.annotate(
        boundary.name, top_of(boundary), xytext=(0, 2), textcoords="offset points", ha="center", va="bottom",
        fontsize=7, color=INK, zorder=9, annotation_clip=True, parse_math=False,
        bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.6},
    )  # fmt: skip


def draw_many(axes: Axes, t: Floats, values: Floats, what: str) -> Floats:
    """Many lines over the same times as bands: all of them, the middle half, the median. values: (k, m).

    Gives least, median and greatest (k, 3) at each time, NaN where there is none.
    """
    known = values[:, np.isfinite(values).any(axis=0)]
    if not known.shape[1]:
        return np.full((len(t), 3), np.nan)
    least, lower, median, upper, greatest = quantiles(known, (0.0, 0.25, 0.5, 0.75, 1.0)).T
    color = PALETTE[0]
    label = f"least to greatest of {known.shape[1]} {what}s"
    axes.fill_between(t, least, greatest, color=color, alpha=0.15, linewidth=0, label=label)
    axes.fill_between(t, lower, upper, color=color, alpha=0.35, linewidth=0, label="middle half")
    for extreme in (least, greatest):
        axes.plot(t, extreme, color=color, linewidth=0.8)
    axes.plot(t, median, color=INK, linewidth=1.4, label="median")
    return np.column_stack([least, median, greatest])


def quantiles(values: Floats, shares: Sequence[float]) -> Floats:
    """Quantiles (k, q) of each row of values (k, m), between neighbours straight; NaN in a row do not count,
    and one of nothing else has NaN."""
    ordered = np.sort(values, axis=1)  # NaN last
    last = np.maximum(np.isfinite(values).sum(axis=1) - 1, 0)[:, None]
    places = last * np.array(shares)
    below = np.floor(places).astype(np.int64)
    low = np.take_along_axis(ordered, below, axis=1)
    high = np.take_along_axis(ordered, np.minimum(below + 1, last), axis=1)
    out: Floats = low + (places - below) * (high - low)
    return out


NOT_BESIDE: Final = "zenoh"
"""Its threads are not Python's: a process in which it is loaded is not forked."""
_BLOCKED: Final = (signal.SIGINT, signal.SIGHUP)


def side_by_side(tasks: Sequence[Callable[[], object]], processes: int | None = None) -> None:
    """Does all tasks, the first ones first, in so many processes, at most one for each core.

    What a task changes in memory may be lost: its results are files. A task that a fork has not finished, for
    whatever reason, is done here, so that what it raises is raised here.
    """
    if processes is None:
        processes = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    processes = min(processes, len(tasks))
    if processes < 2 or len(tasks) > 255 or threading.active_count() > 1 or NOT_BESIDE in sys.modules:
        for task in tasks:
            task()
        return
    # Who is free takes the next number out of one pipe, and puts it into the other when that is done.
    waiting, given = os.pipe()
    finished, tell = os.pipe()
    os.write(given, bytes(range(len(tasks))))
    os.close(given)
    forks: list[int] = []
    done: set[int] = set()
    try:
        forks += [_fork(tasks, waiting, tell) for _ in range(processes - 1)]
        os.close(tell)
        tell = -1
        while taken := os.read(waiting, 1):
            tasks[taken[0]]()
            done |= set(taken)
        while told := os.read(finished, 1):  # until all forks have ended
            done |= set(told)
    finally:
        for fork in forks:
            with suppress(ProcessLookupError):
                os.kill(fork, signal.SIGKILL)
            os.waitpid(fork, 0)
        for end in (waiting, finished, tell):
            if end >= 0:
                os.close(end)
    for number, task in enumerate(tasks):
        if number not in done:
            task()


def _fork(tasks: Sequence[Callable[[], object]], waiting: int, tell: int) -> int:
    """A process that does tasks as long as some wait; its number. A Ctrl-C is its starter's to answer."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
    try:
        with warnings.catch_warnings():
            # Python warns of any second thread, as numpy's, which is made again in a fork.
            warnings.simplefilter("ignore", DeprecationWarning)
            fork = os.fork()
        if fork:
            return fork
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            while taken := os.read(waiting, 1):
                tasks[taken[0]]()
                os.write(tell, taken)
        finally:
            os._exit(0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
