"""``python -m handfast.plant --fleet FILE --robot ID``: a simulated body, or one that is a plugin, as a
process.

It starts where the fleet file has it start; with ``--pose=X,Y,HEADING`` (m, m, W; rad, counter-clockwise from
x) there; with ``--pose-file FILE`` where that file has it last, so that a process that starts again finds its
body where it was. With ``--look`` a vehicle is only looked at. With ``--with ID,ID`` it is the process of the
bodies of these robots, too (`plant.pool`), whose logs it writes into the folder ``--logs DIR``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from math import isfinite
from pathlib import Path

from handfast.agent.common.errors import FAILED
from handfast.agent.common.plugins import PluginError
from handfast.agent.common.time import Clock
from handfast.agent.fleet import plants
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import FLOAT_MAX
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import StartError
from handfast.plant.backend import Begin, Place, PlantBackend
from handfast.plant.server import PersistentBody, PoseFile, PoseFileError
from handfast.plant.server import main as serve


def place(text: str) -> Place:
    """Reads the value of ``--pose``: x, y (m, W), heading (rad, counter-clockwise from x).

    Raises:
        argparse.ArgumentTypeError: it is not three finite numbers.
    """
    try:
        x, y, heading = map(float, text.split(","))
    except ValueError:
        x = y = heading = float("nan")
    if not all(isfinite(value) and abs(value) <= FLOAT_MAX for value in (x, y, heading)):
        raise argparse.ArgumentTypeError(
            f"must be X,Y,HEADING in m, m and rad, such as --pose=1.5,-0.2,1.57, got {text!r}"
        )
    return x, y, heading


def ids(text: str) -> list[int]:
    """Reads the value of ``--with``: numbers of robots.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    if not all(part.isascii() and part.isdigit() and len(part) <= 9 for part in text.split(",")):
        raise argparse.ArgumentTypeError(f"must be numbers of robots such as 2,3,4, got {text!r:.80}")
    return [int(part) for part in text.split(",")]


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process; returns its exit status.

    Args:
        argv: the command line after the program's name; None: that of this process.
    """
    parser = argparse.ArgumentParser(prog="python -m handfast.plant", add_help=False, allow_abbrev=False)
    parser.add_argument(
        "--pose",
        type=place,
        metavar="X,Y,HEADING",
        help="where the body starts, m, m, rad (default: the file's)",
    )
    parser.add_argument(
        "--pose-file", type=Path, metavar="FILE", help="where the body is kept, and starts again"
    )
    parser.add_argument("--look", action="store_true", help="only look at a vehicle")
    parser.add_argument(
        "--with",
        dest="beside",
        type=ids,
        default=[],
        metavar="ID,ID",
        help="serve the simulated bodies of these robots, too, behind a router",
    )
    parser.add_argument(
        "--logs",
        type=Path,
        metavar="DIR",
        help="where these write their logs, one each (default: with the first)",
    )
    options, rest = parser.parse_known_args(argv)
    if options.beside and (options.pose is not None or options.pose_file is not None):
        parser.error("--with: a place is one body's; let each start where the fleet file has it")
    if options.logs is not None and not options.beside:
        parser.error("--logs: goes with --with; the log of one body is what its process prints")

    def make(fleet: Fleet, robot: int, clock: Clock, log: Log) -> PlantBackend:
        kind = fleet.robot(robot).kind
        if not kind.body:
            raise StartError(f"its plant is {kind.name}: its process is python -m {kind.program}")

        def body(at: Place | None) -> PlantBackend:
            made: PlantBackend = plants.attribute(kind.body)(
                fleet, robot, Begin(clock.now_ns(), at, None, options.look, log)
            )
            return made

        try:
            if options.pose_file is None:
                return body(options.pose)
            pose_file = PoseFile(options.pose_file)
            return PersistentBody(body(options.pose or pose_file.place), pose_file)
        except PluginError as error:
            raise StartError(str(error)) from None
        except PoseFileError as error:
            if error.transient:
                raise
            raise StartError(str(error)) from None

    try:
        return serve(rest, "python -m handfast.plant", make, options.beside, options.logs, [parser])
    except PoseFileError as error:
        print(f"plant: {error}", file=sys.stderr)
        return FAILED


if __name__ == "__main__":
    sys.exit(main())
