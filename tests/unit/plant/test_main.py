"""A plant's process: where a body stands that starts again, and which missions are its own."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from agent.common.time import NS_PER_S
from agent.fleet.loading import digest, load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.types import Mission
from agent.runtime.clock import RealClock
from deploy.console.data_files import FLEETS
from plant import server
from plant.__main__ import place
from plant.unicycle import from_fleet


def test_three_numbers_to_the_last_bit() -> None:
    x, y, heading = -1.0 / 3.0, 2.0 / 3.0, 7.1
    assert place(f"{x!r},{y!r},{heading!r}") == (x, y, heading)


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "0,inf,0", "0,0,1e16", "1;2;3"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=r"^must be X,Y,HEADING in m, m and rad, such as"):
        place(text)


@pytest.mark.parametrize("written_out", [False, True])
def test_a_plant_knows_the_mission_of_its_fleet_however_that_is_written(
    written_out: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Operators send the digest of the fleet with its formation written out; a file may leave that to us."""
    fleet = load_fleet(FLEETS / "lattice45.toml")
    whole = resolved(fleet)
    assert (fleet.is_resolved, whole.is_resolved) == (False, True)
    started: list[Any] = []
    monkeypatch.setattr(server, "process_main", lambda *arguments: started.append(arguments[-1]) or 0)

    def make(given: Fleet, robot: int, *_: object) -> Any:
        return from_fleet(given, robot)

    server.main([], "python -m plant", make)
    node = started[0](whole if written_out else fleet, 7, RealClock(), print).node
    mission = Mission(1, NS_PER_S, 2 * NS_PER_S, NS_PER_S, digest(whole))
    node.receive(NS_PER_S, key_expressions.mission(fleet.fleet.name), encode(mission))
    assert not node.rejected
