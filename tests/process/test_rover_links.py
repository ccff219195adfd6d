"""Serial ports and routers between a bridge and its rover: real processes, pseudo terminals, sockets."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import PlantState, Status
from handfast.bridges.mavlink.transport.transport import open_transport
from handfast.deploy.processes.local import VEHICLE
from handfast.deploy.processes.placement import Reservation, place, vehicle
from tests.ground_station import Operator
from tests.process.harness import ADDRESS, PATIENCE_S, measured, no_trouble_in_logs
from tests.process.rover_harness import BASE_PORT, Rovers, pair_of_rovers, rovers
from tests.rover_serial import SerialCable

BAUD = 57_600


@contextmanager
def on_ports(folder: Path) -> Iterator[tuple[Rovers, dict[int, SerialCable], dict[int, Path]]]:
    """Two rovers with cables to serial ports, nothing started or plugged in yet, and the ports' names."""
    names = {robot: Path(f"/dev/shm/handfast-test-{secrets.token_hex(4)}-{robot}") for robot in (1, 2)}
    connected = [f"robot.{robot}.mavlink.connection={name}" for robot, name in names.items()]
    placed = place(pair_of_rovers(*connected, f"robot_defaults.mavlink.baud={BAUD}"))
    ports = Reservation(ADDRESS, BASE_PORT + 2048, 4)
    vehicles, cables = {}, {}
    for robot, name in names.items():
        own = ports.base + 1 + robot
        each = vehicle(placed.fleet, robot, ports.base + robot - 1)
        vehicles[robot] = replace(each, arguments=(f"--listen=tcp:{ADDRESS}:{own}", *each.arguments[1:]))
        cables[robot] = SerialCable(name, own, BAUD)
    try:
        with Rovers(placed.fleet, folder, vehicles) as fleet:
            yield fleet, cables, names
    finally:
        for cable in cables.values():
            cable.unplug()
        ports.close()
        placed.ports.close()


def told(fleet: Rovers, says: str) -> None:
    """Robot 1's bridge says so in its line of the link, and in its log; without words of its own making."""
    fleet.wait(
        lambda: says in fleet.checks(1).get("link", ("", ""))[1], f"the line of the link says {says!r}"
    )
    assert fleet.checks(1)["link"][0] == "blocking"
    fleet.wait(lambda: says in fleet.log(1, "plant").read_text(), f"the log says {says!r}")
    no_trouble_in_logs(fleet.folder)


@pytest.mark.long
def test_what_is_wrong_with_a_port_is_told_until_it_drives(tmp_path: Path) -> None:
    with on_ports(tmp_path / "r") as (fleet, cables, names):
        fleet.start(1, VEHICLE)
        fleet.start(1, "plant")
        told(fleet, f"cannot open {names[1]}: no such device; ")
        cables[1].baud = 115_200
        cables[1].plug_in()
        other = os.open(names[1], os.O_RDWR | os.O_NOCTTY)  # this process: whoever has it is named
        told(fleet, f"another program has it open (process {os.getpid()}, ")
        os.close(other)
        told(fleet, f"bytes come at {BAUD} baud, but no MAVLink: another speed?")
        cables[1].baud = BAUD
        fleet.wait(lambda: fleet.checks(1).get("link", ("", ""))[0] == "ok", "the rover is heard")
        fleet.wait(lambda: (state := fleet.plant(1)) is not None and state.obeying, "it obeys")
        no_trouble_in_logs(fleet.folder)


def test_a_port_that_is_unplugged_in_mid_drive_and_put_back(tmp_path: Path) -> None:
    with on_ports(tmp_path / "r") as (fleet, cables, names):
        for cable in cables.values():
            cable.plug_in()
        fleet.start_all()
        fleet.drive()
        for robot, name in names.items():
            fleet.wait(lambda robot=robot: fleet.moving(robot), f"robot {robot} moves")
            assert fleet.checks(robot)["link"] == ("ok", f"system {robot} on {name}")
        out_ns = time.time_ns()
        cables[2].unplug()
        took, _ = fleet.first(out_ns, Status, 2, lambda m: m.state == "fault", "its agent says fault")
        measured("seconds to fault", took)
        fleet.wait(lambda: "no such device" in fleet.plant(2).note, "its bridge says why")
        assert fleet.states()[1] in ("running", "degraded")
        fleet.wait(lambda: time.time_ns() > out_ns + 4 * NS_PER_S, "four seconds pass")
        cables[2].plug_in()
        fleet.wait(lambda: "may have had it" in fleet.plant(2).note, "its operator may have had it")
        assert fleet.states()[2] != "running"
        back_ns = time.time_ns()
        fleet.resume(2)
        fleet.wait(lambda: fleet.states()[2] == "running" and fleet.moving(2), "robot 2 drives again")
        measured("seconds until it drives on", (time.time_ns() - back_ns) / NS_PER_S)
        no_trouble_in_logs(fleet.folder)


@pytest.mark.long
def test_behind_a_router_with_two_ground_stations(tmp_path: Path) -> None:
    with rovers(tmp_path / "r", routed=1, others=2) as (fleet, router, ports), ExitStack() as stack:
        assert router is not None
        operators = [
            stack.enter_context(
                Operator(open_transport(f"udpin:{ADDRESS}:{port}", 0, time.time_ns), f"station {port}")
            )
            for port in ports
        ]
        asked = 0

        def work() -> None:
            nonlocal asked
            for operator in operators:
                operator.poll()
                if operator.system is not None and len(operator.parameters) == 0:
                    asked += 1
                    operator.send(mavlink.MAVLink_param_request_list_message(operator.system, 1))

        fleet.drive()
        fleet.wait(lambda: work() or fleet.moving(1), "robot 1 moves")
        for operator in operators:
            operator.parameters.clear()  # ask again, while it drives
        since_ns = time.time_ns()
        fleet.wait(lambda: work() or time.time_ns() > since_ns + 5 * NS_PER_S, "time passes", PATIENCE_S)
        states = [state for _, state in fleet.since(since_ns, PlantState, 1)]
        assert states
        assert all(state.healthy and state.driving and state.obeying for state in states), fleet.told()
        assert asked >= 2
        assert all(len(operator.parameters) > 10 for operator in operators), "they get what they ask for"
        assert fleet.checks(1)["link"][0] == "ok"
        assert fleet.checks(1)["ground station"] == ("ok", "system 255")
        assert "other bridges" not in fleet.checks(1)
        assert set(router.setpoints) == {(1, 191)}
        assert router.setpoints[1, 191] > 50
        no_trouble_in_logs(fleet.folder)
