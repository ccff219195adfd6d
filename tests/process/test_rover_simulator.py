"""The rover simulator as a process: its sockets, its command line, its end."""

from __future__ import annotations

import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.bridges.mavlink.ardupilot import constants
from tests.process.harness import ADDRESS, PATIENCE_S, environment, no_trouble, wait_for

SERVER = (sys.executable, "-P", "-m", "handfast.bridges.mavlink.simulator")


class Simulator:
    """One simulated rover as a process; what it says goes to a file."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.err_file = folder / "stderr"
        with open(self.err_file, "wb") as err:
            self.process = subprocess.Popen(
                [*SERVER, *arguments], env=environment(), stdin=subprocess.DEVNULL, stderr=err
            )

    @property
    def said(self) -> str:
        return self.err_file.read_text()

    def wait_for(self, look: Callable[[], Any], what: str) -> Any:
        return wait_for(look, what, report=lambda: self.said)

    def port(self, transport: str) -> int:
        """Of its first listening port of that kind, once it listens."""
        pattern = re.compile(rf"listens on {transport}:.*:(\d+)")
        return int(self.wait_for(lambda: pattern.search(self.said), f"a {transport} port")[1])


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Simulator]]:
    started: list[Simulator] = []

    def begin(*arguments: str) -> Simulator:
        started.append(Simulator(tmp_path, *arguments))
        return started[-1]

    yield begin
    for simulator in started:
        if simulator.process.poll() is None:
            simulator.process.kill()
        simulator.process.wait()
        no_trouble(simulator.said, "the simulator")


class Client:
    """A socket with a codec: what it heard of the vehicle is in `heard`, by name."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.codec = mavlink.MAVLink(None, 255, 190)
        self.codec.robust_parsing = True
        self.heard: dict[str, list[Any]] = {}
        self.ended = False

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: Any) -> None:
        self.socket.send(message.pack(self.codec))

    def heartbeat(self) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))

    def look(self) -> None:
        while select.select([self.socket], [], [], 0)[0]:
            try:
                data = self.socket.recv(65_536)
            except ConnectionError:
                data = b""
            if not data:
                self.ended = True
                return
            for message in self.codec.parse_buffer(data) or ():
                if message.get_srcComponent() == constants.COMPONENT_AUTOPILOT:
                    self.heard.setdefault(message.get_type(), []).append(message)

    def has(self, name: str) -> list[Any]:
        self.look()
        return self.heard.get(name, [])


def tcp(port: int) -> Client:
    return Client(socket.create_connection((ADDRESS, port)))


def udp(port: int | None = None) -> Client:
    """To a port, or on a port of its own for somebody who sends there."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if port is None:
        connection.bind((ADDRESS, 0))
    else:
        connection.connect((ADDRESS, port))
    return Client(connection)


def test_it_listens_and_sends_and_drives_and_ends(start: Callable[..., Simulator]) -> None:
    with udp() as radio:
        simulator = start(
            f"--connect=udp:{ADDRESS}:{radio.socket.getsockname()[1]}",
            f"--listen=udp:{ADDRESS}:0",
            f"--listen=tcp:{ADDRESS}:0",
            "--system=7",
            "--warm",
            "--hand-over",
            "--home",
            "-35.36,149.16,584,90",
        )
        with udp(simulator.port("udp")) as ground, tcp(simulator.port("tcp")) as bridge:
            ground.heartbeat()
            for client in (radio, ground, bridge):
                (beat, *_) = simulator.wait_for(lambda c=client: c.has("HEARTBEAT"), "a heartbeat")
                assert beat.get_srcSystem() == 7
                assert beat.type == constants.TYPE_GROUND_ROVER
            bridge.send(mavlink.MAVLink_command_long_message(7, 1, 511, 0, 32, 40_000, 0, 0, 0, 0, 0))

            answered = 0

            def drives() -> bool:
                nonlocal answered
                positions = bridge.has("LOCAL_POSITION_NED")
                if len(positions) > answered:
                    answered = len(positions)
                    bridge.send(
                        mavlink.MAVLink_set_position_target_local_ned_message(
                            0, 7, 1, 8, constants.MASK_SPEED_AND_YAW_RATE, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0
                        )
                    )
                return any(m.vy > 0.4 for m in positions)

            simulator.wait_for(drives, "driving east")
            assert bridge.has("COMMAND_ACK")[0].result == constants.RESULT_ACCEPTED
            assert len(ground.has("LOCAL_POSITION_NED")) < 0.5 * len(bridge.has("LOCAL_POSITION_NED"))
    simulator.process.send_signal(signal.SIGINT)
    assert simulator.process.wait(PATIENCE_S) == 0
    assert "rover 7: GUIDED, armed" in simulator.said
    assert "rover 7: ending (SIGINT)" in simulator.said


@pytest.mark.long
def test_one_tcp_client_at_a_time_and_a_reboot_sends_it_away(start: Callable[..., Simulator]) -> None:
    simulator = start(f"--listen=tcp:{ADDRESS}:0", "--warm", "--boot=4")
    port = simulator.port("tcp")
    with tcp(port) as first, tcp(port) as second:
        simulator.wait_for(lambda: len(first.has("HEARTBEAT")) >= 2, "two heartbeats")
        assert second.has("HEARTBEAT") == []
        first.socket.close()
        simulator.wait_for(lambda: second.has("HEARTBEAT"), "a heartbeat for the second")
        second.send(mavlink.MAVLink_command_long_message(1, 1, 246, 0, 1, 0, 0, 0, 0, 0, 0))
        simulator.wait_for(lambda: second.look() or second.ended, "the end of the connection")
        assert second.has("COMMAND_ACK")[0].result == constants.RESULT_ACCEPTED
    with tcp(port) as third:
        simulator.wait_for(lambda: third.has("SYSTEM_TIME"), "the time since the boot")
        assert third.has("SYSTEM_TIME")[0].time_boot_ms < 4_000
    assert "rover 1: reboots" in simulator.said


@pytest.mark.long
def test_a_crash_ends_the_process(start: Callable[..., Simulator]) -> None:
    simulator = start(f"--listen=udp:{ADDRESS}:0", "--warm", "--hand-over")
    with udp(simulator.port("udp")) as client:

        def ended() -> bool:
            with suppress(ConnectionRefusedError):
                client.send(
                    mavlink.MAVLink_set_position_target_local_ned_message(
                        0, 1, 1, 8, 0x5C7, 0, 0, 0, float("nan"), 0, 0, 0, 0, 0, 0, 0
                    )
                )
            return simulator.process.poll() is not None

        simulator.wait_for(ended, "the end")
    assert simulator.process.returncode == 1
    assert "rover 1: crashed: a setpoint that is not finite" in simulator.said


HANDFAST = (sys.executable, "-P", "-m", "handfast.deploy.cli")


def signing(folder: Path, port: int | str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """`handfast keys --signing` for robot 1 of the rovers, which is at that TCP port or connection."""
    connection = f"tcp:{ADDRESS}:{port}" if isinstance(port, int) else port
    command = [
        *(*HANDFAST, "keys", "rovers", "--signing", "--robot=1", *arguments),
        f"--set=robot.1.mavlink.connection={connection}",
        f"--set=robot.1.mavlink.signing_key={folder / 'keys' / 'one'}",
    ]
    return command, {**environment(), "XDG_STATE_HOME": str(folder / "state")}


def test_it_is_given_a_key_by_the_command_and_signs(start: Callable[..., Simulator], tmp_path: Path) -> None:
    simulator = start(f"--listen=tcp:{ADDRESS}:0", f"--listen=tcp:{ADDRESS}:0", "--warm")
    simulator.wait_for(lambda: simulator.said.count("listens on tcp") == 2, "two ports")
    first, second = map(int, re.findall(r"listens on tcp:.*:(\d+)", simulator.said))
    for port, what in ((first, "signs with its key from now on"), (second, "had its key already, and signs")):
        command, variables = signing(tmp_path, port, "--make-keys")
        ended = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=60.0)
        assert ended.returncode == 0, ended
        assert ended.stdout.splitlines()[-1] == f"robot 1: {what} (system 1)"
        assert ended.stderr.startswith("The keys cross the links in clear")
        assert len(ended.stderr.splitlines()) == 1
    assert "rover 1: signs from now on" in simulator.said
