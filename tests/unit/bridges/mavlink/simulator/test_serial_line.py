"""A simulated rover's serial port: its name, its speed, who is there."""

from __future__ import annotations

import fcntl
import os
import tempfile
import termios
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.simulator.serial_line import (
    RECEIVE_ROOM,
    SEND_ROOM,
    SerialEndpoint,
    SerialLine,
    parse_serial,
    speed_of,
)
from handfast.bridges.mavlink.simulator.settings import SettingsError
from handfast.bridges.mavlink.simulator.sockets import open_lines, readable
from handfast.bridges.mavlink.simulator.uart import misread

TIOCGEXCL = 0x80045440
NOW_NS = 1_800_000_000 * NS_PER_S


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "rover"


@pytest.fixture
def line(path: Path) -> Iterator[SerialLine]:
    line = SerialLine(SerialEndpoint(str(path), 57_600))
    yield line
    line.close()


Open = Callable[[int], serial.Serial]


@pytest.fixture
def opened(path: Path) -> Iterator[Open]:
    ports = []

    def open_(baud: int) -> serial.Serial:
        ports.append(serial.Serial(str(path), baud, timeout=0, write_timeout=0, exclusive=True))
        return ports[-1]

    yield open_
    for port in ports:
        port.close()


def test_an_endpoint_is_written_as_it_is_read() -> None:
    text = "serial:/dev/serial/by-path/pci-0000:00:14.0:57600"
    assert str(parse_serial(text)) == text
    assert parse_serial(text).baud == 57_600


@pytest.mark.parametrize(
    "text",
    ["serial:/dev/ttyS0", "serial:rover:57600", "serial:/r:fast", "serial:/r:300", "serial:/r:9000000"],
)
def test_what_is_no_endpoint(text: str) -> None:
    with pytest.raises(SettingsError, match=r"baud|BAUD"):
        parse_serial(text)


def test_bytes_both_ways_in_their_time(line: SerialLine, opened: Open) -> None:
    port = opened(57_600)
    line.send([b"\x00\xff\x03\x0d\x11"], NOW_NS)
    assert line.receive(NOW_NS) == b""
    assert port.read(100) == b""
    assert line.due_ns is not None
    assert NOW_NS < line.due_ns < NOW_NS + NS_PER_S // 500
    line.receive(line.due_ns)
    assert port.read(100) == b"\x00\xff\x03\x0d\x11"
    port.write(b"\xfd\x0a\x0d\x11\x13")
    later_ns = NOW_NS + NS_PER_S
    assert readable([line], later_ns) == [(0, line)]
    assert line.receive(later_ns) == b""
    assert line.receive(later_ns + NS_PER_S // 100) == b"\xfd\x0a\x0d\x11\x13"


def test_what_is_said_to_nobody_is_lost(line: SerialLine, opened: Open) -> None:
    line.send([b"early"], NOW_NS)
    assert line.receive(NOW_NS + NS_PER_S) == b""
    port = opened(57_600)
    assert port.read(100) == b""
    port.close()
    line.send([b"late"], NOW_NS + 2 * NS_PER_S)
    assert line.receive(NOW_NS + 3 * NS_PER_S) == b""
    assert line.due_ns is None, "nobody is there"
    assert opened(57_600).read(100) == b""


def test_a_message_that_does_not_fit_is_left_out(line: SerialLine, opened: Open) -> None:
    port = opened(57_600)
    line.send([bytes([k]) * 100 for k in range(10)], NOW_NS)
    line.receive(NOW_NS + NS_PER_S)
    assert port.read(2000) == b"".join(bytes([k]) * 100 for k in range(SEND_ROOM // 100))


def test_too_much_at_once_does_not_wait_for_seconds(line: SerialLine, opened: Open) -> None:
    port = opened(57_600)
    for _ in range(3):
        port.write(bytes(RECEIVE_ROOM))
    line.receive(NOW_NS)
    assert len(line.receive(NOW_NS + 10 * NS_PER_S)) <= RECEIVE_ROOM


def test_at_another_speed_both_ways_are_garbage(line: SerialLine, opened: Open) -> None:
    port = opened(115_200)
    assert speed_of(line.watched()) == 115_200
    said = bytes(range(100))
    line.send([said], NOW_NS)
    line.receive(NOW_NS + NS_PER_S)
    came = port.read(1000)
    assert came == misread(said, 57_600, 115_200)
    assert came != said
    port.write(said)
    line.receive(NOW_NS + 2 * NS_PER_S)
    assert line.receive(NOW_NS + 3 * NS_PER_S) == misread(said, 115_200, 57_600)
    port.baudrate = 57_600
    port.write(said)
    line.receive(NOW_NS + 4 * NS_PER_S)
    assert line.receive(NOW_NS + 5 * NS_PER_S) == said


def test_speeds_without_a_name_are_read_too(line: SerialLine, opened: Open) -> None:
    port = opened(250_000)
    assert speed_of(line.watched()) == 250_000
    assert speed_of(port.fileno()) == 250_000


def test_whoever_had_it_alone_leaves_it_to_the_next(line: SerialLine, opened: Open) -> None:
    port = opened(57_600)
    fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
    line.receive(NOW_NS)
    port.close()
    line.receive(NOW_NS + 1)
    exclusive = fcntl.ioctl(opened(57_600).fileno(), TIOCGEXCL, bytes(4))
    assert not any(exclusive)


def test_it_does_not_echo_before_it_is_opened_as_a_port(line: SerialLine, path: Path) -> None:
    terminal = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        assert not termios.tcgetattr(terminal)[3] & (termios.ECHO | termios.ICANON)
    finally:
        os.close(terminal)


def test_the_name_is_a_link_and_goes_at_the_end(path: Path) -> None:
    line = SerialLine(SerialEndpoint(str(path), 57_600))
    assert os.readlink(path).startswith("/dev/pts/")
    line.close()
    assert not path.is_symlink()


def test_a_name_left_by_one_that_was_killed_is_taken_over(path: Path) -> None:
    path.symlink_to("/dev/pts/98765")
    line = SerialLine(SerialEndpoint(str(path), 57_600))
    assert path.exists()
    path.unlink()
    path.symlink_to("/dev/pts/98765")  # it is another's by now
    line.close()
    assert path.is_symlink()


def test_a_name_in_use_is_not_taken(line: SerialLine, path: Path) -> None:
    with pytest.raises(SettingsError, match=rf"another handfast program uses it \(process {os.getpid()}\)"):
        SerialLine(SerialEndpoint(str(path), 115_200))
    assert path.exists()


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_what_is_no_link_of_a_simulator_stays(path: Path, kind: str) -> None:
    if kind == "file":
        path.write_text("mine")
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(path.parent)
    before = path.lstat()
    with pytest.raises(SettingsError, match="it is left as it is"):
        SerialLine(SerialEndpoint(str(path), 57_600))
    assert path.lstat().st_ino == before.st_ino


def test_a_folder_that_is_not_there_is_told(path: Path) -> None:
    with pytest.raises(SettingsError, match=r"cannot listen on serial:.*No such file"):
        open_lines([SerialEndpoint(str(path / "port"), 57_600)])


def test_a_vehicle_that_starts_again_has_nothing_to_say(line: SerialLine, opened: Open) -> None:
    port = opened(57_600)
    line.send([bytes(100)], NOW_NS)
    line.restart()
    line.receive(NOW_NS + NS_PER_S)
    assert port.read(1000) == b""
    assert line.is_open
