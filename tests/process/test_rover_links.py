"""Serial ports and routers between a bridge and its rover: real processes, pseudo terminals, sockets."""

from __future__ import annotations

import os
import re
import secrets
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import PlantState, Status
from handfast.bridges.mavlink.transport.transport import open_transport
from handfast.deploy.processes.local import VEHICLE
from handfast.deploy.processes.placement import place, vehicle
from handfast.deploy.processes.ports import Reservation
from tests.ground_station import Operator
from tests.process.harness import ADDRESS, PATIENCE_S, measured, no_trouble_in_logs, wait_for
from tests.process.rover_harness import BASE_PORT, Rovers, pair_of_rovers

DRIVEN_S = 8.0
STREAMS = ("ATTITUDE", "LOCAL_POSITION_NED")


@contextmanager
def on_ports(folder: Path, *overrides: str, **ends: int) -> Iterator[tuple[Rovers, dict[int, Path]]]:
    """Two rovers at serial ports, nothing started yet, and the names of the ports.

    Args:
        ends: `rover1`, `rover2`: the speed of a rover's own end of its line, in baud.
    """
    names = {robot: Path(f"/dev/shm/handfast-test-{secrets.token_hex(4)}-{robot}") for robot in (1, 2)}
    connected = [f"robot.{robot}.mavlink.connection={name}" for robot, name in names.items()]
    placed = place(pair_of_rovers(*connected, *overrides))
    ports = Reservation(ADDRESS, BASE_PORT + 2048, 2)
    vehicles = {}
    for robot, name in names.items():
        each = vehicle(placed.fleet, robot, ports.base + robot - 1)
        line = f"--listen=serial:{name}:{ends[f'rover{robot}']}"
        vehicles[robot] = replace(each, arguments=(line, *each.arguments[1:]))
    try:
        with Rovers(placed.fleet, folder, vehicles) as fleet:
            yield fleet, names
    finally:
        for name in names.values():
            name.unlink(missing_ok=True)  # of those that were killed
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


def rates(fleet: Rovers, robot: int) -> list[float]:
    """Counted of each message of the state, Hz."""
    lines = [fleet.checks(robot).get(name, ("", "")) for name in STREAMS]
    return [float(found.partition(" Hz of ")[0]) for _, found in lines if " Hz of " in found]


def drives_for(fleet: Rovers, seconds: float) -> None:
    since_ns = time.time_ns()
    fleet.wait(lambda: time.time_ns() > since_ns + seconds * NS_PER_S, "time passes")
    for robot in fleet.fleet.ids:
        states = [state for _, state in fleet.since(since_ns, PlantState, robot)]
        assert states
        assert all(state.healthy and state.driving for state in states), fleet.told()


@pytest.mark.long
def test_two_rovers_drive_at_the_speeds_of_their_ports(tmp_path: Path) -> None:
    slow = ("robot.1.mavlink.baud=57600", "robot.1.mavlink.state_rate_hz=10")
    fast = ("robot.2.mavlink.baud=921600", "robot.2.mavlink.state_rate_hz=25")
    with on_ports(tmp_path / "r", *slow, *fast, rover1=57_600, rover2=921_600) as (fleet, names):
        fleet.start_all()
        fleet.drive()
        for robot, name in names.items():
            fleet.wait(lambda robot=robot: fleet.moving(robot), f"robot {robot} moves")
            assert fleet.checks(robot)["link"] == ("ok", f"system {robot} on {name}")
        drives_for(fleet, DRIVEN_S)
        for robot, asked_hz in ((1, 10.0), (2, 25.0)):
            found = rates(fleet, robot)
            assert len(found) == len(STREAMS), fleet.checks(robot)
            assert min(found) > 0.9 * asked_hz, fleet.checks(robot)
            trip = float(re.findall(r"(\d+) ms", fleet.checks(robot)["round trip"][1])[0])
            measured(f"ms of round trip, robot {robot}", trip)
            assert trip < 150.0
        for robot in names:
            assert fleet.end(robot, VEHICLE) == 0
            assert not names[robot].is_symlink()
        no_trouble_in_logs(fleet.folder)


@pytest.mark.long
def test_what_is_wrong_with_a_port_is_told_until_it_drives(tmp_path: Path) -> None:
    with on_ports(tmp_path / "r", "robot.1.mavlink.baud=57600", rover1=115_200, rover2=57_600) as (
        fleet,
        names,
    ):
        fleet.start(1, "plant")
        told(fleet, f"cannot open {names[1]}: no such device; ")
        holding = fleet.vehicles[1]
        fleet.start(1, VEHICLE)
        wait_for(names[1].exists, "the port")
        other = os.open(names[1], os.O_RDWR | os.O_NOCTTY)  # this process: whoever has it is named
        told(fleet, f"another program has it open (process {os.getpid()}, ")
        os.close(other)
        told(fleet, "bytes come at 57600 baud, but no MAVLink: another speed?")
        assert fleet.end(1, VEHICLE) == 0
        line, *rest = holding.arguments
        fleet.vehicles[1] = replace(holding, arguments=(line.replace("115200", "57600"), *rest))
        fleet.start(1, VEHICLE)
        fleet.wait(lambda: fleet.checks(1).get("link", ("", ""))[0] == "ok", "the rover is heard")
        fleet.wait(lambda: (state := fleet.plant(1)) is not None and state.obeying, "it obeys")
        no_trouble_in_logs(fleet.folder)


def test_a_port_that_is_unplugged_in_mid_drive_and_put_back(tmp_path: Path) -> None:
    with on_ports(tmp_path / "r", rover1=115_200, rover2=115_200) as (fleet, names):
        fleet.start_all()
        fleet.drive()
        fleet.wait(lambda: fleet.moving(2), "robot 2 moves")
        out_ns = time.time_ns()
        fleet.processes[2, VEHICLE].kill()
        took, _ = fleet.first(out_ns, Status, 2, lambda m: m.state == "fault", "its agent says fault")
        measured("seconds to fault", took)
        fleet.wait(lambda: "no such device" in fleet.plant(2).note, "its bridge says why")
        assert fleet.states()[1] in ("running", "degraded")
        fleet.processes[2, VEHICLE].wait()
        assert names[2].is_symlink(), "left by the one that was killed"
        fleet.wait(lambda: time.time_ns() > out_ns + 4 * NS_PER_S, "four seconds pass")
        fleet.start(2, VEHICLE)
        fleet.wait(lambda: "may have had it" in fleet.plant(2).note, "its operator may have had it")
        assert fleet.states()[2] != "running"
        back_ns = time.time_ns()
        fleet.resume(2)
        fleet.wait(lambda: fleet.states()[2] == "running" and fleet.moving(2), "robot 2 drives again")
        measured("seconds until it drives on", (time.time_ns() - back_ns) / NS_PER_S)
        no_trouble_in_logs(fleet.folder)


class Router:
    """Copies every datagram of each place to all the others, as a MAVLink router does: `port` is where the
    vehicle sends, `to` are who waits for it. `setpoints` counts who sends those to the vehicle.
    """

    def __init__(self, port: int, to: list[int]) -> None:
        self.setpoints: Counter[tuple[int, int]] = Counter()
        self._near = socket.socket(type=socket.SOCK_DGRAM)
        self._near.bind((ADDRESS, port))
        self._far = [(socket.socket(type=socket.SOCK_DGRAM), (ADDRESS, each)) for each in to]
        for each, _ in self._far:
            each.bind((ADDRESS, 0))
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        peer: Any = None
        codec = mavlink.MAVLink(None)
        codec.robust_parsing = True
        while True:
            sockets = [self._near, self._woken, *(each for each, _ in self._far)]
            ready, _, _ = select.select(sockets, (), ())
            if self._woken in ready:
                return
            for here in ready:
                try:
                    data, sender = here.recvfrom(65_536)
                except ConnectionRefusedError:
                    continue
                if here is self._near:
                    peer = sender
                elif peer is not None:
                    self._near.sendto(data, peer)
                    for message in codec.parse_buffer(data) or ():
                        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                            self.setpoints[message.get_srcSystem(), message.get_srcComponent()] += 1
                for each, place_of in self._far:
                    if each is not here:
                        each.sendto(data, place_of)

    def close(self) -> None:
        self._wake.send(b"x")
        self._thread.join(5.0)
        for each in (self._near, self._wake, self._woken, *(each for each, _ in self._far)):
            each.close()


@pytest.mark.long
def test_behind_a_router_with_two_ground_stations(tmp_path: Path) -> None:
    placed = place(pair_of_rovers())
    fleet, extra = placed.fleet, Reservation(ADDRESS, BASE_PORT + 2048, 3)
    vehicles = {each.robot: each for each in placed.vehicles}
    bridge_port = int(vehicles[1].ground_station.rpartition(":")[2])
    vehicles[1] = vehicle(fleet, 1, extra.base)
    stations = [extra.base + 1, extra.base + 2]
    router = Router(extra.base, [bridge_port, *stations])
    try:
        with Rovers(fleet, tmp_path / "r", vehicles) as rovers:
            operators = [
                Operator(open_transport(f"udpin:{ADDRESS}:{port}", 0, time.time_ns), f"station {port}")
                for port in stations
            ]
            asked = 0

            def work() -> None:
                nonlocal asked
                for operator in operators:
                    operator.poll()
                    if operator.system is not None and len(operator.parameters) == 0:
                        asked += 1
                        operator.send(mavlink.MAVLink_param_request_list_message(operator.system, 1))

            with operators[0], operators[1]:
                rovers.start_all()
                rovers.wait_until_all("ready")
                rovers.drive()
                rovers.wait(lambda: work() or rovers.moving(1), "robot 1 moves")
                for operator in operators:
                    operator.parameters.clear()  # ask again, while it drives
                since_ns = time.time_ns()
                rovers.wait(
                    lambda: work() or time.time_ns() > since_ns + 5 * NS_PER_S, "time passes", PATIENCE_S
                )
                states = [state for _, state in rovers.since(since_ns, PlantState, 1)]
                assert states
                assert all(state.healthy and state.driving and state.obeying for state in states), (
                    rovers.told()
                )
                assert asked >= 2
                assert all(len(operator.parameters) > 10 for operator in operators), (
                    "they get what they ask for"
                )
                assert rovers.checks(1)["link"][0] == "ok"
                assert rovers.checks(1)["ground station"] == ("ok", "system 255")
                assert "other bridges" not in rovers.checks(1)
                assert set(router.setpoints) == {(1, 191)}
                assert router.setpoints[1, 191] > 50
            no_trouble_in_logs(rovers.folder)
    finally:
        router.close()
        extra.close()
        placed.ports.close()
