"""``python -m handfast.bridges.mavlink --fleet FILE --robot ID [--look]``: the bridge to one rover, as a
process.

With ``--look`` it only looks: it arms nothing, whatever the fleet file says.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from collections.abc import Sequence
from functools import partial
from typing import Final

from handfast.agent.common.time import Clock
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import SIMULATOR, MavlinkSection
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import StartError
from handfast.bridges.mavlink.session.identity import SigningError, open_signing
from handfast.bridges.mavlink.transport.transport import open_transport
from handfast.plant.backend import PlantBackend
from handfast.plant.server import main as serve

PROGRAM: Final = "python -m handfast.bridges.mavlink"


def make(fleet: Fleet, robot: int, clock: Clock, log: Log, *, look: bool = False) -> PlantBackend:
    """The bridge of a robot, its connection being opened.

    Args:
        look: it arms nothing.

    Raises:
        handfast.agent.runtime.process.StartError: the fleet file does not say how to reach it, or its key
        cannot be used.
    """
    section = fleet.robot(robot).section(MavlinkSection)
    if section is None or section.connection is None or fleet.datum is None:
        raise StartError(f'its plant in the fleet file, "{fleet.robot(robot).plant}", is no such vehicle')
    if section.connection == SIMULATOR:
        raise StartError(
            "its connection is a simulator, which only `handfast run` starts; start one with `handfast "
            "rover-simulator`, and give its place with --set robot_defaults.mavlink.connection=tcp:HOST:PORT"
        )
    try:
        # Here: it may be that the packages of a vehicle's machine are not there, which needs one clear line.
        from handfast.bridges.mavlink.bridge.backend import MavlinkPlant, session
    except ModuleNotFoundError as error:
        raise StartError(f"it needs the package {error.name}: pip install 'handfast[rover]'") from None
    try:
        signing = None
        if section.signing_key is not None:
            signing = open_signing(fleet.fleet.name, robot, section.signing_key, clock.now_ns())
        link = session(fleet, robot, signing, secrets.randbits(32))
        transport = open_transport(section.connection, section.baud, clock.now_ns, section.system)
    except (SigningError, ValueError) as error:
        raise StartError(str(error)) from None
    return MavlinkPlant(fleet, robot, link, transport, log, look=look)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process; returns its exit status."""
    parser = argparse.ArgumentParser(prog=PROGRAM, add_help=False, allow_abbrev=False)
    parser.add_argument("--look", action="store_true", help="only look at the vehicle: arm nothing")
    options, rest = parser.parse_known_args(argv)
    return serve(rest, PROGRAM, partial(make, look=options.look), own=[parser])


if __name__ == "__main__":
    sys.exit(main())
