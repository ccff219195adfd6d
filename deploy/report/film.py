"""A run as a film: the plan view over time, above it the time, below it the nearest two robots.

Drawn by matplotlib; written by ffmpeg where there is one, else as a GIF by Pillow.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from handfast.agent.control.boundaries import Circle, Polygon, fence_of, obstacles_of
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.playback.marks import DRIVES, FAILED, LOOKS, RESTS, TROUBLED, UNREADY
from handfast.deploy.playback.scene import nearest
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report.export import FILMS
from handfast.deploy.report.plotting import (
    DASHED,
    GREY,
    INK,
    PALETTE,
    RED,
    body_arrow,
    draw_boundary,
    styled,
    view,
)
from handfast.deploy.report.whole_file import whole_file
from handfast.deploy.verdict.run_result import RunResult

LONG_S: Final = 30.0
"""A drive that is longer is shown faster, so that its film takes so long, unless a speed is asked for."""
TRAIL_S: Final = 8.0
NAMES_MAX: Final = 50
"""Robots of a larger fleet have no numbers."""
_HOLDS: Final = PALETTE[2]
_OFF: Final = PALETTE[4]
_COLORS: Final[Mapping[str, str]] = {DRIVES: INK, TROUBLED: _OFF, FAILED: RED, RESTS: GREY, UNREADY: GREY}
_DPI: Final = 100


class FilmError(RecordingError):
    """A film that cannot be made; the text is one line."""


def film(
    result: RunResult,
    out: Path,
    *,
    fps: int,
    width_px: int,
    speed: float | None = None,
    shown: Callable[[int, int], None] = lambda _done, _all: None,
) -> float:
    """Writes the film of a run to `out`, an .mp4 or .gif; gives how long it takes to see, s.

    Args:
        fps: pictures a second.
        width_px: of the picture; its height follows the ground.
        speed: so many times as fast as the drive was; None: as fast, or faster where that takes `LONG_S`.
        shown: told with each picture, how many there have been and how many there are.

    Raises:
        FilmError: no such format, an mp4 without ffmpeg, it cannot be written, or no robot was ever seen. No
            half film is left.
    """
    write = _writer(out)
    if not np.isfinite(result.analysis.hands).any():
        raise FilmError("there is no film of this run: it has no place of any robot")
    end_s = float(result.analysis.grid[-1])
    pace = max(1.0, end_s / LONG_S) if speed is None else speed
    count = max(1, round(end_s / pace * fps))
    with styled():
        picture = _Picture(result, width_px)

        def pictures() -> Iterator[Pixels]:
            for number in range(count):
                shown(number + 1, count)
                yield picture.at(min(number * pace / fps, end_s))

        with whole_file(out, FilmError) as part:
            write(part, picture.size, fps, pictures())
    return count / fps


# --- writers ---------------------------------------------------------------------------------

Pixels = NDArray[np.uint8]
"""A picture: (height, width, 4), RGBA."""
Writer = Callable[[Path, tuple[int, int], int, Iterator[Pixels]], None]
"""Writes pictures of a width and height (px), so many a second, to a file."""

_FFMPEG: Final = "ffmpeg"
_ENCODERS: Final = {
    ".mp4": ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart"],
    ".gif": ["-filter_complex", "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=none"],
}


def _writer(out: Path) -> Writer:
    """What writes a film of the format that the name asks for; raises as `film`."""
    kind = out.suffix.removeprefix(".").lower()
    if kind not in FILMS:
        raise FilmError(f"{out}: a film is an .mp4 or a .gif; give it such a name")
    if shutil.which(_FFMPEG):
        return _by_ffmpeg
    if kind == "mp4":
        raise FilmError(f"{out}: an mp4 needs ffmpeg (Debian, Ubuntu: apt install ffmpeg); a gif does not")
    return _by_pillow


def _by_ffmpeg(path: Path, size: tuple[int, int], fps: int, pictures: Iterator[Pixels]) -> None:
    command = [_FFMPEG, "-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgba"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", str(fps), "-i", "-", "-an"]
    command += [*_ENCODERS[path.suffix.lower()], str(path)]
    # In a session of its own: a Ctrl-C is for us, who then end it.
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        pipe, errors = process.stdin, process.stderr
        assert pipe is not None
        assert errors is not None
        try:
            with suppress(BrokenPipeError):  # where it has ended it says why
                for picture in pictures:
                    pipe.write(picture.tobytes())
                pipe.close()
            said = errors.read().decode(errors="replace").strip().splitlines()
            if process.wait() != 0:
                why = said[-1] if said else "it does not say why"
                raise FilmError(f"ffmpeg cannot write the film: {why}")
        finally:
            process.kill()
            with suppress(BrokenPipeError):
                pipe.close()


def _by_pillow(path: Path, _: tuple[int, int], fps: int, pictures: Iterator[Pixels]) -> None:
    from PIL import Image

    images = (Image.fromarray(each[:, :, :3]).quantize(64, dither=Image.Dither.NONE) for each in pictures)
    next(images).save(
        path, format="GIF", save_all=True, append_images=images, duration=round(1000 / fps), loop=0
    )


# --- pictures --------------------------------------------------------------------------------


class _Picture:
    """The picture of one moment, drawn again and again.

    Attributes:
        size: width and height, px; both even, as encoders ask.
    """

    def __init__(self, result: RunResult, width_px: int) -> None:
        self._result = result
        analysis, fleet = result.analysis, result.fleet
        fence = fence_of(fleet)
        ground = [*obstacles_of(fleet), *([] if fence is None else [fence])]
        known = analysis.hands.reshape(-1, 2)
        known = known[np.isfinite(known).all(axis=1)]
        low, high = view(known.min(axis=0), known.max(axis=0), ground)
        margin = 0.08 * max(float((high - low).max()), 0.5)
        low, high = low - margin, high + margin
        span = high - low
        plan_px = min(max(round(width_px * float(span[1] / span[0])), width_px // 3), width_px)
        self.size: Final = _even(width_px), _even(plan_px + width_px // 6)
        figure = Figure((self.size[0] / _DPI, self.size[1] / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(figure)
        share = plan_px / self.size[1]
        self._plan = figure.add_axes((0.0, 1.0 - share, 1.0, share))
        self._curve = figure.add_axes((0.06, 0.28 * (1.0 - share), 0.92, 0.6 * (1.0 - share)))
        self._still(self._plan, low, high, ground)
        self._below(self._curve)
        self._trails = LineCollection([], colors=GREY, linewidths=1.0, alpha=0.7)
        self._edges = LineCollection([], linewidths=1.5)
        self._bodies = PolyCollection([], zorder=4)
        for drawn in (self._trails, self._edges, self._bodies):
            self._plan.add_collection(drawn)
        self._dots = self._plan.scatter([], [], s=7, color=INK, zorder=5)
        few = len(analysis.ids) <= NAMES_MAX
        halo = [patheffects.withStroke(linewidth=2.5, foreground="white")]
        self._names = [
            self._plan.text(0, 0, str(robot), fontsize=8, zorder=6, path_effects=halo)
            for robot in analysis.ids
            if few
        ]
        self._time = self._plan.text(0.01, 0.99, "", transform=self._plan.transAxes, va="top", fontsize=11)
        self._headings = [data.heading(analysis.grid) for data in result.recording.robots.values()]
        self._size_m = max(0.015 * float(span.max()), max(abs(each.hand_offset_m) for each in fleet.robots))

    def _still(self, axes: Axes, low: Floats, high: Floats, ground: Sequence[Circle | Polygon]) -> None:
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.tick_params(length=0, labelbottom=False, labelleft=False)
        for spine in axes.spines.values():
            spine.set_visible(False)
        for boundary in ground:
            draw_boundary(axes, boundary)

    def _below(self, axes: Axes) -> None:
        analysis = self._result.analysis
        apart = nearest(analysis)
        axes.plot(analysis.grid, apart, color=PALETTE[0], linewidth=1.2)
        axes.axhline(analysis.safe_m, color=RED, linewidth=1.0, linestyle=DASHED)
        most = np.nanmax(apart) if np.isfinite(apart).any() else analysis.safe_m
        axes.set_ylim(0.0, 1.15 * max(float(most), analysis.safe_m))
        axes.set_xlim(0.0, max(float(analysis.grid[-1]), 1e-3))
        title = "nearest two robots (m) over the drive (s); dashed: the safe distance"
        axes.set_title(title, fontsize=8, fontweight="normal", pad=3)
        axes.tick_params(labelsize=7)
        self._now = axes.axvline(0.0, color=INK, linewidth=1.0)

    def at(self, t: float) -> Pixels:
        """The picture at fleet time `t`: (height, width, 4) bytes, RGBA."""
        result, analysis = self._result, self._result.analysis
        k = int(np.searchsorted(analysis.grid, t + 1e-9, side="right")) - 1
        hands, wanted = analysis.hands[k], analysis.wanted[k]
        since = int(np.searchsorted(analysis.grid, t - TRAIL_S))
        self._trails.set_segments(list(analysis.hands[since : k + 1].swapaxes(0, 1)))
        in_force = np.flatnonzero(np.isfinite(wanted))
        self._edges.set_segments([hands[list(pair)] for pair in analysis.edges[in_force]])
        off = analysis.distances[k, in_force] / wanted[in_force] - 1.0
        self._edges.set_color([_HOLDS if abs(each) <= SETTLED else _OFF for each in off])
        self._edges.set_linestyle(["solid" if each <= SETTLED else DASHED for each in off])
        states = [(data.status.at(t) or ("", ""))[0] for data in result.recording.robots.values()]
        self._bodies.set_verts(
            [
                body_arrow(hand, float(heading[k]), robot.hand_offset_m, self._size_m)
                for hand, heading, robot in zip(hands, self._headings, result.fleet.robots, strict=True)
            ]
        )
        self._bodies.set_color([_COLORS[LOOKS.get(state, UNREADY)] for state in states])
        self._dots.set_offsets(hands)
        for name, place in zip(self._names, hands, strict=False):
            name.set_visible(bool(np.isfinite(place).all()))
            name.set_position((place[0] + 0.4 * self._size_m, place[1] + 0.4 * self._size_m))
        self._time.set_text(f"{result.fleet.fleet.name}  {t:.1f} s")
        self._now.set_xdata([t, t])
        self._canvas.draw()  # type: ignore[no-untyped-call]
        return np.asarray(self._canvas.buffer_rgba())  # type: ignore[no-untyped-call]


def _even(number: int) -> int:
    return number + number % 2
