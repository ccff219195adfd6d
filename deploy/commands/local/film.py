"""The command ``handfast film``: a run as a film."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from math import isfinite
from pathlib import Path

from agent.common.exit import PASSED
from deploy.console.arguments import describe, place_for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast film`` takes."""
    describe(
        parser,
        ": robots from above, and below the least distance of any two. A GIF, or with ffmpeg an mp4.",
    )
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="FILE",
        help="where to, an .mp4 or .gif (default: RUN/film.mp4, or film.gif without ffmpeg)",
    )
    parser.add_argument(
        "--speed",
        type=_number(0.01, 1000.0),
        metavar="X",
        help="so many times as fast as the drive (default: 1, or more for one of over 30 s, to take 30 s)",
    )
    parser.add_argument("--fps", type=_number(1, 60), default=20, metavar="N", help="pictures a second (20)")
    parser.add_argument(
        "--width", type=_number(200, 3840), default=960, metavar="PX", help="width of the picture (960)"
    )
    parser.set_defaults(command=_film)


def _number(least: float, most: float) -> Callable[[str], float]:
    """What reads a number from `least` to `most`; a whole one where `least` is."""
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


def _film(options: argparse.Namespace) -> int:
    from deploy.console.interrupt import Interrupt
    from deploy.recording.mcap_reader import read_run
    from deploy.report.film import film, name_for
    from deploy.verdict.run_result import RunResult

    folder = Path(options.folder)
    recording = read_run(folder)
    for warning in recording.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    out = Path(options.out) if options.out else folder / name_for()

    def shown(done: int, count: int) -> None:
        if done * 10 // count > (done - 1) * 10 // count:
            print(f"{done} of {count} pictures", file=sys.stderr)

    result = RunResult(recording)
    with Interrupt().caught() as interrupt, interrupt.answered("it ends here", raises=True):
        long_s = film(result, out, speed=options.speed, fps=options.fps, width_px=options.width, shown=shown)
    print(f"{long_s:.1f} s to see", file=sys.stderr)
    print(out)
    return PASSED
