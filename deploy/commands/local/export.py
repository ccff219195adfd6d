"""The command ``handfast export``: a run's data as tables or a ROS 2 bag, or its drive as a film."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from math import isfinite
from pathlib import Path

from handfast.agent.common.errors import PASSED
from handfast.deploy.console.arguments import InputError, describe, place_for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``handfast export``."""
    describe(
        parser,
        ". A film shows the robots from above, and below them the distance between the nearest two; an mp4 "
        "needs ffmpeg.",
    )
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.add_argument(
        "--format",
        default="csv",
        metavar="FORMAT",
        help="csv (default), parquet, json, rosbag2; or a film: mp4, gif",
    )
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="PATH",
        help="folder to write to (default: RUN/export); file of a film (default: RUN/film.FORMAT)",
    )
    film = parser.add_argument_group("of a film")
    film.add_argument(
        "--speed",
        type=_number(0.01, 1000.0),
        metavar="X",
        help="speed relative to the drive (default: 1, or faster if the film would take more than 30 s)",
    )
    film.add_argument("--fps", type=_number(1, 60), metavar="N", help="frames per second (default: 20)")
    film.add_argument("--width", type=_number(200, 3840), metavar="PX", help="width, pixels (default: 960)")
    parser.set_defaults(command=_export)


def _number(least: float, most: float) -> Callable[[str], float]:
    """Return a reader of numbers from `least` to `most`, whole ones if `least` is."""
    what = "a whole number" if isinstance(least, int) else "a number"

    def read(text: str) -> float:
        try:
            value = type(least)(text)
        except ValueError:
            value = least - 1
        if not (isfinite(value) and least <= value <= most):
            raise argparse.ArgumentTypeError(f"must be {what} from {least:g} to {most:g}, got {text!r}")
        return value

    return read


def _export(options: argparse.Namespace) -> int:
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.report.export import FILMS, export

    if options.format not in FILMS and any((options.speed, options.fps, options.width)):
        raise InputError(f"--speed, --fps and --width belong to --format {' or '.join(FILMS)}")
    folder, out = Path(options.folder), Path(options.out) if options.out else None
    with Interrupt().caught() as interrupt, interrupt.answered("it ends here", raises=True):
        if options.format in FILMS:
            written = [_film(options, folder, out or folder / f"film.{options.format}")]
        else:
            written = export(folder, options.format, out, warn=_warn)
    for path in written:
        print(path)
    return PASSED


def _film(options: argparse.Namespace, folder: Path, out: Path) -> Path:
    from handfast.deploy.recording.mcap_reader import read_run
    from handfast.deploy.report.film import film
    from handfast.deploy.verdict.run_result import RunResult

    if out.suffix.lower() != f".{options.format}":
        raise InputError(f"--out {out}: the name of this film must end in .{options.format}")
    recording = read_run(folder)
    for warning in recording.warnings:
        _warn(warning)

    def shown(done: int, count: int) -> None:
        if done * 10 // count > (done - 1) * 10 // count:
            print(f"{done} of {count} frames", file=sys.stderr)

    fps, width_px = options.fps or 20, options.width or 960
    long_s = film(RunResult(recording), out, speed=options.speed, fps=fps, width_px=width_px, shown=shown)
    print(f"the film takes {long_s:.1f} s", file=sys.stderr)
    return out


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)
