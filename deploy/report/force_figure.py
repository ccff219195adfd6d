"""The picture of forces and torques over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agent.formation.points import Floats
from deploy.report.plotting import (
    LEGEND_MAX,
    draw_many,
    new_figure,
    note,
    nth_line,
)
from deploy.verdict.run_result import RunResult


def forces(result: RunResult) -> Figure:
    """Navigation and constraint forces per unit mass, and what is asked of each body, over time."""
    recording = result.recording
    figure = new_figure(8.6, 5.6)
    panels = figure.subplots(2, 2, sharex=True)
    grid = recording.grid
    unit = "per unit mass (m/s²)"
    columns: list[tuple[str, str, Callable[[Any], tuple[Floats, Floats]]]] = [
        ("Navigation force", f"$|F_n|$ {unit}", lambda r: (r.hand.t, _length(r.hand, "navigation"))),
        ("Constraint force", f"$|F_c|$ {unit}", lambda r: (r.hand.t, _length(r.hand, "constraint"))),
        ("Force asked of the plant", "force (N)", lambda r: (r.wrench.t, r.wrench["force"])),
        ("Torque asked of the plant", "torque (N m)", lambda r: (r.wrench.t, r.wrench["torque"])),
    ]
    few = len(recording.ids) <= LEGEND_MAX
    for axes, (title, label, column) in zip(panels.flat, columns, strict=True):
        axes.set_title(title)
        axes.set_ylabel(label)
        axes.set_xlim(0.0, max(float(grid[-1]), 1e-3))
        series = [column(robot) for robot in recording.robots.values()]
        if not any(len(t) for t, _ in series):
            note(axes, "nothing was recorded")
        elif few:
            for index, (t, values) in enumerate(series):
                inside = (t >= 0) & (t <= grid[-1])
                axes.plot(t[inside], values[inside], linewidth=0.9, **nth_line(index))
        else:
            table = np.column_stack([np.interp(grid, t, values) for t, values in series if len(t)])
            draw_many(axes, grid, table, "robot")
    for axes in panels[1]:
        axes.set_xlabel("fleet time (s)")
    if few:
        for index, robot in enumerate(recording.ids):
            label = f"robot {robot}"
            panels[0, 0].plot([], [], linewidth=1.3, label=label, **nth_line(index))
    handles, labels = panels[0, 0].get_legend_handles_labels()
    if handles:
        rows = 1 if len(handles) <= 6 else 2
        figure.legend(handles, labels, loc="outside upper left", ncols=-(-len(handles) // rows))
    return figure


def _length(table: Any, name: str) -> Floats:
    length: Floats = np.hypot(table[f"{name}_x"], table[f"{name}_y"])
    return length
