"""All pictures of a run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from handfast.deploy.console.arguments import FIGURE_FORMATS
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import distance_figure, force_figure, links, timing_figure
from handfast.deploy.report.plotting import side_by_side, styled, write
from handfast.deploy.report.trajectory_figure import trajectories
from handfast.deploy.verdict.run_result import RunResult

PICTURES: Final[Mapping[str, Callable[[RunResult], Figure]]] = {
    "trajectories": trajectories,
    "distances": distance_figure.distances,
    "forces": force_figure.forces,
    "timing": timing_figure.timing,
    links.NAME: links.links,
}
_WORTH_DRAWING: Final[Mapping[str, Callable[[RunResult], bool]]] = {
    "distances": distance_figure.worth_drawing,
    "forces": force_figure.worth_drawing,
    "timing": timing_figure.worth_drawing,
    links.NAME: links.worth_drawing,
}
"""Whether there is anything to see on one; without an entry there always is."""
_OF_THE_PAGE: Final = "png"
_LONG: Final = frozenset({"forces"})
"""What takes as long as two others is begun first."""


def figure(result: RunResult, name: str) -> Figure:
    """One of `PICTURES`, in the style of a report."""
    with styled():
        return PICTURES[name](result)


def write_figures(folder: Path, result: RunResult, formats: Sequence[str] = ()) -> dict[str, Path]:
    """Draws those of `PICTURES` on which there is something to see into `folder`, as PNG and in other formats
    that are asked for, of `FIGURE_FORMATS`; the paths of the PNGs by name.

    What was drawn before is removed, whatever its format: all that lie there then are of one drawing.

    Raises:
        RecordingError: when one cannot be written.
    """
    others = [each for each in FIGURE_FORMATS if each in formats and each != _OF_THE_PAGE]
    out: dict[str, Path] = {}
    written: set[Path] = set()
    tasks = {}
    for name, draw in PICTURES.items():
        if name not in _WORTH_DRAWING or _WORTH_DRAWING[name](result):
            out[name] = folder / f"{name}.{_OF_THE_PAGE}"
            more = [folder / f"{name}.{each}" for each in others]
            tasks[name] = partial(write, out[name], partial(draw, result), more)
            written |= {out[name], *more}
    side_by_side([tasks[name] for name in sorted(tasks, key=_LONG.__contains__, reverse=True)])
    remove_figures(folder, written)
    return out


def remove_figures(folder: Path, but: Collection[Path] = ()) -> None:
    """Removes the figures of a run from its folder, as far as they are there, and one half written.

    Raises:
        RecordingError: when one cannot be removed.
    """
    for path in (folder / f"{name}.{each}" for name in PICTURES for each in FIGURE_FORMATS):
        if path not in but and path.is_file():
            try:
                path.unlink()
            except OSError as error:
                raise RecordingError(f"cannot remove {path}: {error.strerror or error}") from error
