"""When which fault held, drawn over the time axis of a figure: a strip of labelled bars above it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from handfast.deploy.faults.process_actions import WORDS
from handfast.deploy.faults.rules import Lane, lanes
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.plotting import GREY, INK, PALETTE, RED

LANES_MAX: Final = 9
"""Rules with a bar of their own; further ones share the last."""
_LANE_IN: Final = 0.19
_CHARACTER: Final = 0.0098
"""Width of a character of a lane's text, as a share of the axes'."""
_TEXT_MAX: Final = int(1.0 / _CHARACTER) - 2
_MARKS_MAX: Final = 12
"""More kills and pauses than this are drawn without words."""
# The reds and greens of the distances mean something else; these do not.
_COLORS: Final = (PALETTE[1], PALETTE[5], PALETTE[3], PALETTE[4], PALETTE[0], PALETTE[6], PALETTE[2], GREY)


def time_axes(
    figure: Figure, recording: Recording, end_s: float, heights: Sequence[float] = (1.0,)
) -> list[Axes]:
    """Axes of these relative heights over the times 0 to `end_s` of the fleet, below a strip of its faults.

    The figure grows by the height of the strip. Each rule has a bar where it held, which goes on, faintly,
    through the axes; what was done to processes is a line there. Without faults there is no strip.
    """
    rules = drawn_lanes(recording, end_s)
    width, height = figure.get_size_inches()
    strip_in = _LANE_IN * len(rules)
    figure.set_size_inches(width, height + strip_in)
    plot_in = [(height - 0.6) * share / sum(heights) for share in heights]
    ratios = [strip_in, *plot_in] if rules else plot_in
    rows = figure.subplots(len(ratios), 1, height_ratios=ratios, sharex=True, squeeze=False)[:, 0].tolist()
    panels: list[Axes] = rows[1:] if rules else rows
    if rules:
        _draw_strip(rows[0], panels, rules, end_s)
    for axes in panels:
        _mark_events(axes, recording, end_s, spoken=axes is panels[0])
    panels[0].set_xlim(0.0, end_s)
    panels[-1].set_xlabel("fleet time (s)")
    return panels


def _draw_strip(strip: Axes, panels: Sequence[Axes], lanes: Sequence[Lane], end_s: float) -> None:
    strip.set_ylim(len(lanes), 0.0)
    strip.set_yticks([])
    strip.grid(False)
    strip.tick_params(bottom=False, labelbottom=False)
    for spine in strip.spines.values():
        spine.set_visible(False)
    faint = 0.1 if len(lanes) <= 4 else 0.06  # where many overlap the lines must still be seen
    for row, lane in enumerate(lanes):
        color = _COLORS[row % len(_COLORS)]
        bars = [Rectangle((first, row + 0.12), last - first, 0.76) for first, last in lane.times]
        strip.add_collection(PatchCollection(bars, facecolor=color, edgecolor="none", alpha=0.38))
        _write(strip, lane, row, end_s)
        if sum(last - first for first, last in lane.times) > 0.98 * end_s:
            continue  # what always holds needs no shading
        for axes in panels:
            through = [Rectangle((first, 0.0), last - first, 1.0) for first, last in lane.times]
            shade = PatchCollection(through, facecolor=color, edgecolor="none", alpha=faint, zorder=0.5)
            shade.set_transform(axes.get_xaxis_transform())
            axes.add_collection(shade, autolim=False)


def drawn_lanes(recording: Recording, end_s: float) -> list[Lane]:
    """The lanes of a strip: the first ones, and one for all the rest of many."""
    found = lanes(recording, end_s)
    if len(found) <= LANES_MAX:
        return found
    rest = found[LANES_MAX - 1 :]
    return [*found[: LANES_MAX - 1], Lane(f"{len(rest)} further rules", _merged(rest))]


def _merged(lanes: Sequence[Lane]) -> list[tuple[float, float]]:
    """The times at which any of them holds, apart from each other."""
    out: list[tuple[float, float]] = []
    for first, last in sorted(each for lane in lanes for each in lane.times):
        if out and first <= out[-1][1]:
            out[-1] = out[-1][0], max(last, out[-1][1])
        else:
            out.append((first, last))
    return out


def _write(strip: Axes, lane: Lane, row: int, end_s: float) -> None:
    """What a lane is, from where it begins; up to where it ends, or the axes end, when that is too long."""
    text = lane.text if len(lane.text) <= _TEXT_MAX else lane.text[: _TEXT_MAX - 1] + "…"
    first, last = min(start for start, _ in lane.times), max(end for _, end in lane.times)
    room = len(text) * _CHARACTER * end_s
    x, side = first, "left"
    if first + room > end_s:
        x, side = (last if last > room else end_s), "right"
    strip.annotate(
        text, (x, row + 0.52), xytext=(3 if side == "left" else -3, 0), textcoords="offset points",
        ha=side, va="center_baseline", fontsize=7, color=INK, annotation_clip=False,
        parse_math=False,  # names and authors are texts of others: a $ in them is a $
    )  # fmt: skip


def _mark_events(axes: Axes, recording: Recording, end_s: float, *, spoken: bool) -> None:
    """Lines where processes were killed, started, paused and continued; said in words when `spoken`."""
    epoch_ns = recording.epoch_ns or 0
    events = [(event, (event.time_ns - epoch_ns) / 1e9) for event in recording.events]
    events = [(event, t) for event, t in events if 0.0 <= t <= end_s]
    spoken = spoken and len(events) <= _MARKS_MAX
    for number, (event, t) in enumerate(events):
        ends = event.what in ("kill", "stop")
        axes.axvline(t, color=RED if ends else GREY, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1.5)
        if spoken:
            # In turn at three heights: what is killed is often started again soon.
            left = t > 0.8 * end_s
            axes.annotate(
                f"{event.role} {event.robot} {WORDS[event.what]}", (t, 0.92 - 0.05 * (number % 3)),
                xycoords=("data", "axes fraction"), xytext=(-3 if left else 3, 0), textcoords="offset points",
                ha="right" if left else "left", va="top", fontsize=7, color=RED if ends else INK,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.7},
            )  # fmt: skip
