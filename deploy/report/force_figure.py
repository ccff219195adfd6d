"""The picture of forces and torques over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from handfast.agent.formation.points import Floats
from handfast.deploy.report.layout import GridLayout
from handfast.deploy.report.plotting import LEGEND_MAX, draw_many, new_figure, note, nth_marked
from handfast.deploy.verdict.run_result import RunResult

Series = tuple[Floats, Floats]
"""Times (k,) s of one robot, and its values (k,)."""
_PER_MASS: Final = "per unit mass (m/s²)"
"""Without symbols: matplotlib takes a third as long again for a picture with a formula on it."""
_PANELS: Final[Mapping[str, tuple[str, Callable[[Any], Series]]]] = {
    "Navigation force": (_PER_MASS, lambda robot: (robot.hand.t, _length(robot.hand, "navigation"))),
    "Constraint force": (_PER_MASS, lambda robot: (robot.hand.t, _length(robot.hand, "constraint"))),
    "Force asked of the plant": ("force (N)", lambda robot: (robot.wrench.t, robot.wrench["force"])),
    "Torque asked of the plant": ("torque (N m)", lambda robot: (robot.wrench.t, robot.wrench["torque"])),
}


def worth_drawing(result: RunResult) -> bool:
    """Whether any force was recorded during the drive."""
    return bool(_recorded(result))


def forces(result: RunResult) -> Figure:
    """Navigation and constraint forces per unit mass, and what is asked of each body, over time.

    What nothing was recorded of has no panel.
    """
    recording = result.recording
    recorded = _recorded(result)
    if not recorded:
        figure = new_figure(8.6, 2.9, GridLayout())
        note(figure.add_subplot(), "no forces were recorded")
        return figure
    rows = -(-len(recorded) // 2)
    figure = new_figure(8.6, 2.8 * rows, GridLayout())
    panels = figure.subplots(rows, min(len(recorded), 2), sharex=True, squeeze=False).ravel().tolist()
    for axes in panels[len(recorded) :]:
        axes.remove()
    grid = recording.grid
    few = len(recording.ids) <= LEGEND_MAX
    drawn: set[int] = set()
    for axes, (title, series) in zip(panels, recorded.items(), strict=False):
        axes.set_title(title)
        axes.set_ylabel(_PANELS[title][0])
        axes.set_xlim(0.0, max(float(grid[-1]), 1e-3))
        if few:
            for index, (t, values) in enumerate(series):
                if len(t):
                    drawn.add(index)
                    axes.plot(t, values, linewidth=0.9, **nth_marked(index, len(t)))
        else:
            table = np.column_stack([np.interp(grid, t, values) for t, values in series if len(t)])
            draw_many(axes, grid, table, "robot")
    for axes in panels[max(len(recorded) - 2, 0) : len(recorded)]:
        axes.set_xlabel("fleet time (s)")
        axes.tick_params(labelbottom=True)
    if few:
        for index, robot in enumerate(recording.ids):
            if index in drawn:
                style = {**nth_marked(index, 1), "markevery": None}
                panels[0].plot([], [], linewidth=1.3, label=f"robot {robot}", **style)
    handles, labels = panels[0].get_legend_handles_labels()
    rows = 1 if len(handles) <= 6 else 2
    figure.legend(handles, labels, loc="outside upper left", ncols=-(-len(handles) // rows))
    return figure


def _recorded(result: RunResult) -> dict[str, list[Series]]:
    """What every robot sent during the drive, by panel; without those of which nobody sent anything."""
    end_s = float(result.recording.grid[-1])
    out = {}
    for title, (_, column) in _PANELS.items():
        series = []
        for t, values in map(column, result.recording.robots.values()):
            inside = (t >= 0.0) & (t <= end_s)
            series.append((t[inside], values[inside]))
        if any(len(t) for t, _ in series):
            out[title] = series
    return out


def _length(table: Any, name: str) -> Floats:
    length: Floats = np.hypot(table[f"{name}_x"], table[f"{name}_y"])
    return length
