"""A plant's process: where a body stands that starts again, and which missions are its own."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission
from handfast.agent.runtime.loop import RealClock
from handfast.agent.runtime.process import StartError
from handfast.agent.transport.bus import Bus, BusError
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.processes.placement import Reservation
from handfast.plant import server
from handfast.plant.__main__ import main, place
from handfast.plant.unicycle import from_fleet


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
    monkeypatch.setattr(server, "process_main", lambda *arguments: started.append(arguments[3]) or 0)

    def make(given: Fleet, robot: int, *_: object) -> Any:
        return from_fleet(given, robot)

    server.main([], "python -m handfast.plant", make)
    node = started[0](whole if written_out else fleet, 7, RealClock(), print).node
    mission = Mission(1, NS_PER_S, 2 * NS_PER_S, NS_PER_S, digest(whole))
    node.receive(NS_PER_S, key_expressions.mission(fleet.fleet.name), encode(mission))
    assert not node.rejected


PLACE = "--with: a place is one body's; let each start where the fleet file has it"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--with=1,a"], "argument --with: must be numbers of robots such as 2,3,4, got '1,a'"),
        (["--logs=x"], "--logs: goes with --with; the log of one body is what its process prints"),
        (["--with="], "argument --with: must be numbers of robots such as 2,3,4, got ''"),
        (
            ["--with=2", "--pose=1,2,3"],
            PLACE,
        ),
        (
            ["--with=2", "--pose-file=x"],
            PLACE,
        ),
    ],
)
def test_several_bodies_are_named_by_numbers_and_start_where_the_file_has_them(
    options: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--fleet", "fleet.toml", "--robot", "1", *options])
    assert ended.value.code == 2
    assert capsys.readouterr().err.rstrip().endswith(f"python -m handfast.plant: error: {says}")


@pytest.mark.parametrize(
    ("settings", "beside", "says"),
    [
        (
            [],
            [2],
            "--with: the plants of several robots share a process only behind a router, and this file names "
            "none (network.routers)",
        ),
        (['network.routers=["127.0.0.1:9"]'], [2, 9], "fleet pair: there is no robot 9; ids are 1, 2"),
        (['network.routers=["127.0.0.1:9"]'], [2, 1], "--with: robot 1 is named twice"),
        (['network.routers=["127.0.0.1:9"]'], [2], "--logs: there is no folder nowhere"),
    ],
)
def test_several_bodies_are_those_of_other_robots_behind_a_router(
    settings: list[str], beside: list[int], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Any] = []
    monkeypatch.setattr(server, "process_main", lambda *arguments: started.append(arguments[3]) or 0)
    logs = Path("nowhere")
    server.main(
        [], "python -m handfast.plant", lambda given, robot, *_: from_fleet(given, robot), beside, logs
    )
    with pytest.raises((StartError, FleetError), match=f"^{re.escape(says)}$"):
        started[0](resolved(load_fleet(FLEETS / "pair.toml", settings)), 1, RealClock(), print)


def routed_pair() -> Fleet:
    """The pair behind a router, on ports that are free."""
    found = Reservation("127.0.0.1", 20000, 4)
    found.close()
    changes = [f"network.base_port={found.base}", 'network.routers=["127.0.0.1:9"]']
    return resolved(load_fleet(FLEETS / "pair.toml", changes))


@pytest.mark.patches
def test_who_has_several_bodies_lets_nobody_have_a_second_of_one_of_them() -> None:
    fleet = routed_pair()
    held = server.held_ports(fleet, [1, 2])
    with pytest.raises(BusError, match=r"^cannot listen on tcp/127\.0\.0\.1:\d+: the port is in use"):
        Bus(listen=fleet.plant_listens(2), connect=[])
    with pytest.raises(BusError, match=r"^robot 2's plant cannot have tcp/.*: Address already in use; is "):
        server.held_ports(fleet, [2])
    for each in held:
        each.close()
    Bus(listen=fleet.plant_listens(2), connect=[]).close()
