"""All pictures of a run, written into its folder."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from os import PathLike
from pathlib import Path

from matplotlib.figure import Figure

from agent.fleet.model import Fleet
from deploy.analysis.analysis import Analysis
from deploy.recording.recording import Recording
from deploy.report import link_figure
from deploy.report.distance_figure import distances
from deploy.report.force_figure import forces
from deploy.report.plotting import write
from deploy.report.timing_figure import timing
from deploy.report.trajectory_figure import trajectories


def write_figures(
    folder: str | PathLike[str], recording: Recording, fleet: Fleet, analysis: Analysis
) -> dict[str, Path]:
    """Draw the pictures of a run, that of its links only if it is worth one, into `folder` as PNG; the paths
    by name.

    Raises:
        RecordingError: when one cannot be written.
    """
    drawings: dict[str, Callable[[], Figure]] = {
        "trajectories": partial(trajectories, recording, fleet, analysis),
        "distances": partial(distances, recording, fleet, analysis),
        "forces": partial(forces, recording),
        "timing": partial(timing, recording),
    }
    if link_figure.worth_drawing(recording):
        drawings[link_figure.NAME] = partial(link_figure.links, recording)
    out = {}
    for name, draw in drawings.items():
        out[name] = Path(folder) / f"{name}.png"
        write(out[name], draw)
    return out
