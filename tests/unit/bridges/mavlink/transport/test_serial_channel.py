"""A serial port as a channel and as a transport: whole messages, one program, what is wrong with it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport import port_diagnosis
from handfast.bridges.mavlink.transport import transport as transport_module
from handfast.bridges.mavlink.transport.channels import Serial
from handfast.bridges.mavlink.transport.connection_string import Unusable, parse_connection
from handfast.bridges.mavlink.transport.transport import Timing, Transport, open_transport
from tests.rover_serial import misread

TIMING = Timing(retry_s=0.005, retry_max_s=0.02)
BEAT = mavlink.MAVLink_heartbeat_message(10, 3, 81, 4, 4, 3).pack(mavlink.MAVLink(None, 1, 1))


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def until(condition: Callable[[], object]) -> None:
    """Waits for what another thread does; a test that waits in vain is ended by pytest's timeout."""
    pause = threading.Event()
    while not condition():
        pause.wait(0.001)


@pytest.fixture
def wire() -> Iterator[tuple[int, str]]:
    """A serial line: the vehicle's end as a handle, ours as a device."""
    master, slave = os.openpty()
    device = os.ttyname(slave)
    os.close(slave)
    yield master, device
    with contextlib.suppress(OSError):  # a test may have closed it
        os.close(master)


class Time:
    """A clock by which each look takes half a second."""

    def __init__(self) -> None:
        self.now_ns = 1_800_000_000 * NS_PER_S

    def __call__(self) -> int:
        self.now_ns += NS_PER_S // 2
        return self.now_ns


@pytest.fixture
def opened() -> Iterator[Callable[[str], Transport]]:
    transports = []

    def open_(connection: str) -> Transport:
        transports.append(open_transport(connection, 57600, Time(), timing=TIMING))
        return transports[-1]

    yield open_
    for transport in transports:
        transport.close()


def received(transport: Transport) -> bytes:
    out: list[tuple[int, bytes]] = []
    until(lambda: out.extend(transport.receive()) or out)
    return b"".join(data for _, data in out)


def test_bytes_go_both_ways_and_a_device_that_is_gone_is_noticed(
    opened: Callable[[str], Transport], wire: tuple[int, str]
) -> None:
    master, device = wire
    transport = opened(device)
    until(lambda: transport.epoch)
    os.write(master, b"\xfd\x0a\x0d\x11\x13")  # nothing is translated or taken for flow control
    assert received(transport) == b"\xfd\x0a\x0d\x11\x13"
    transport.send(b"\xfd\x0a\x0d\x11\x13")
    assert os.read(master, 100) == b"\xfd\x0a\x0d\x11\x13"
    os.close(master)
    until(lambda: "no such device" in transport.trouble)
    assert transport.transient, "it may be plugged in again"


def test_one_that_is_plugged_in_later_is_opened(
    opened: Callable[[str], Transport], wire: tuple[int, str], tmp_path: Path
) -> None:
    name = tmp_path / "rover"
    transport = opened(str(name))
    until(lambda: "no such device" in transport.trouble)
    assert transport.trouble.startswith(f"cannot open {name}: no such device; ")
    assert transport.trouble.endswith("; to do: plug it in, or name the right one")
    assert transport.transient
    name.symlink_to(wire[1])
    until(lambda: transport.epoch)
    assert transport.trouble == ""


def test_another_speed_is_told_while_it_goes_on_and_no_longer(
    opened: Callable[[str], Transport], wire: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport_module, "LOOK_MS", 5)
    master, device = wire
    transport = opened(device)
    until(lambda: transport.epoch)

    def told(data: bytes) -> None:
        os.write(master, data)
        received(transport)

    until(lambda: told(misread(BEAT, 115_200, 57_600)) or transport.trouble)
    assert transport.trouble.startswith(f"{device}: bytes come at 57600 baud, but no MAVLink: another speed?")
    assert not transport.transient, "somebody has to set it"
    transport.send(b"x")
    assert transport.dropped == 0, "it stays open"
    until(lambda: not transport.trouble)  # nothing comes any more
    until(lambda: told(misread(BEAT, 115_200, 57_600)) or transport.trouble)
    until(lambda: told(BEAT) or not transport.trouble)
    assert transport.epoch == 1


def test_a_program_that_has_it_is_named(opened: Callable[[str], Transport], wire: tuple[int, str]) -> None:
    holding = (
        "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", holding, wire[1]]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        transport = opened(wire[1])
        until(lambda: "cannot open" in transport.trouble)
        name = Path(os.path.realpath(sys.executable)).name
        assert transport.trouble.startswith(f"cannot open {wire[1]}: another program has it open (process ")
        assert f"(process {other.pid}, python" in transport.trouble, name
        assert transport.trouble.endswith("); to do: end it")
        assert not transport.transient
        assert other.stdin is not None
        other.stdin.close()
        until(lambda: transport.epoch)


@pytest.mark.parametrize("device", ["/dev/null", "/dev"])
def test_what_is_no_serial_port_is_told(device: str) -> None:
    with pytest.raises(Unusable, match="this is not a serial port"):
        Serial(parse_connection(device), 57600)


def test_the_kernels_console_is_noted(wire: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_diagnosis, "console_note", lambda device: f"a console is on {device}")
    channel = Serial(parse_connection(wire[1]), 57600)
    assert channel.note == f"a console is on {wire[1]}"
    channel.close()


def test_a_full_line_drops_rather_than_delays(wire: tuple[int, str]) -> None:
    channel = Serial(parse_connection(wire[1]), 57600)
    sent = 0
    while channel.write(bytes(100)):
        sent += 100
    assert 0 < sent < 100_000
    channel.close()


def test_without_pyserial_it_is_said_what_to_install(
    opened: Callable[[str], Transport], wire: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    transport = opened(wire[1])
    until(lambda: "cannot open" in transport.trouble)
    assert "pip install 'handfast[rover]'" in transport.trouble
