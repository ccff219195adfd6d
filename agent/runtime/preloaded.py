"""What one process reads for all that are forked from it (`deploy.processes.forking`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Final

from handfast.agent.fleet.loading import digest, load_fleet, parse_scenario
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.mission_plan import trajectory_parts, written_plan
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, Place

RULE: Final = '[[faults.rule]]\nloss = "1%"\n'
"""Any rule."""
_fleets: Final[dict[str, Fleet]] = {}
_on_start: Final[list[Callable[[], None]]] = []


def preload(path: str) -> Fleet:
    """Reads a fleet file, and imports what its robots need, for `fleet_of` in whatever is forked from here.

    Not for a fleet with plugins: importing one runs the code of others.

    Raises:
        handfast.agent.fleet.model.FleetError: there is none.
    """
    fleet = load_fleet(path)
    for robot in fleet.robots:
        if robot.kind.body:
            import_module(robot.kind.body.partition(":")[0])
    digest(fleet)  # which it remembers
    _read_first(fleet)
    _fleets[path] = fleet
    return fleet


def _read_first(fleet: Fleet) -> None:
    """Reads a rule and a mission. What it takes to read the first of them is remembered, and one that is
    given in a drive is read by all at once."""
    parse_scenario(RULE, fleet.ids)
    parts = trajectory_parts(fleet.trajectory)[::-1]  # as it stands in the file nobody would read it
    mission = Mission(1, 0, 0, 1, digest(fleet), trajectory=parts, robots=(Place(fleet.ids[0], 0.0, 0.0),))
    read = decode(encode(mission))
    assert isinstance(read, Mission)
    written_plan(read, fleet)


def fleet_of(path: str, overrides: Sequence[str] = (), law: str | None = None) -> Fleet:
    """The fleet of a file, as it was read before, or else as it is now with what the command line sets.

    Raises:
        handfast.agent.fleet.model.FleetError: there is none.
    """
    if not overrides and law is None and path in _fleets:
        return _fleets[path]
    return load_fleet(path, overrides, law)


def on_start(call: Callable[[], None]) -> None:
    """Has `call` called once, when this process is on the bus."""
    _on_start.append(call)


def started() -> None:
    """This process is on the bus."""
    while _on_start:
        _on_start.pop()()
