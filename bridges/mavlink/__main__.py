"""``python -m bridges.mavlink --fleet FILE --robot ID``: the bridge to one rover, as a process."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Sequence
from pathlib import Path

from agent.clock import Clock
from agent.fleet import Fleet
from agent.fleet_sections import SIMULATOR, MavlinkSection
from agent.process import Log, StartError
from bridges.mavlink.backend import MavlinkPlant, session
from bridges.mavlink.signing import Signing, SigningError, Timestamps, load_key, state_file
from bridges.mavlink.transport import open_transport
from plant.server import main as serve


def make(fleet: Fleet, robot: int, clock: Clock, log: Log) -> MavlinkPlant:
    """The bridge of a robot, its connection being opened.

    Raises:
        agent.process.StartError: the fleet file does not say how to reach it, or its key cannot be used.
    """
    section = fleet.robot(robot).mavlink
    if section is None or section.connection is None or fleet.datum is None:
        raise StartError(f'it is no plant = "mavlink" in the fleet file, but "{fleet.robot(robot).plant}"')
    if section.connection == SIMULATOR:
        raise StartError(
            "its connection is a simulator, which only `handfast run` starts; start one with `handfast "
            "rover-simulator`, and give its place with --set robot_defaults.mavlink.connection=tcp:HOST:PORT"
        )
    try:
        signing = _signing(section, f"{fleet.fleet.name}-{robot}", clock)
        link = session(fleet, robot, signing, secrets.randbits(32))
        transport = open_transport(section.connection, section.baud, clock.now_ns)
    except (SigningError, ValueError) as error:
        raise StartError(str(error)) from None
    return MavlinkPlant(fleet, robot, link, transport, log)


def _signing(section: MavlinkSection, name: str, clock: Clock) -> Signing | None:
    if section.signing_key is None:
        return None
    key = load_key(Path(section.signing_key).expanduser())
    return Signing(key, Timestamps(state_file(name), clock.now_ns()))


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process; returns its exit status."""
    return serve(argv, "python -m bridges.mavlink", make)


if __name__ == "__main__":
    sys.exit(main())
