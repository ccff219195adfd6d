"""All pictures of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from deploy.report import link_figure
from deploy.report.distance_figure import distances
from deploy.report.force_figure import forces
from deploy.report.plotting import styled, write
from deploy.report.timing_figure import timing
from deploy.report.trajectory_figure import trajectories
from deploy.verdict.run_result import RunResult

PICTURES: Final[Mapping[str, Callable[[RunResult], Figure]]] = {
    "trajectories": trajectories,
    "distances": distances,
    "forces": forces,
    "timing": timing,
    link_figure.NAME: link_figure.links,
}


def figure(result: RunResult, name: str) -> Figure:
    """One of `PICTURES`, in the style of a report."""
    with styled():
        return PICTURES[name](result)


def write_figures(folder: Path, result: RunResult) -> dict[str, Path]:
    """Draws `PICTURES`, that of links only if it is worth one, into `folder` as PNG; the paths by name.

    Raises:
        RecordingError: when one cannot be written.
    """
    out = {}
    for name, draw in PICTURES.items():
        if name != link_figure.NAME or link_figure.worth_drawing(result):
            out[name] = folder / f"{name}.png"
            write(out[name], partial(draw, result))
    return out
