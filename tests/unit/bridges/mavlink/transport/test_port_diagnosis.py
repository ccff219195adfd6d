"""Why a serial port cannot be used: on a machine made of files."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from handfast.bridges.mavlink.transport.connection_string import Unusable
from handfast.bridges.mavlink.transport.port_diagnosis import (
    Finding,
    before_opening,
    console_note,
    forbidden,
    refused,
)

PORT = "/dev/ttyUSB0"
BY_ID = "/dev/serial/by-id/usb-Pixhawk"


class Machine:
    """A /dev, /proc and /sys below a folder. Its devices are files, taken for character devices."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root = root
        self.devices: set[Path] = set()
        for folder in ("dev/serial/by-id", "proc/1/fd", "sys/class/tty"):
            (root / folder).mkdir(parents=True)
        real = Path.stat

        def as_device(path: Path, **options: Any) -> Any:
            found = real(path, **options)
            if Path(os.path.realpath(path)) not in self.devices:
                return found
            return SimpleNamespace(st_mode=stat.S_IFCHR | 0o660, st_gid=found.st_gid, st_rdev=0)

        monkeypatch.setattr(Path, "stat", as_device)

    def device(self, name: str) -> None:
        path = self.root / name[1:]
        path.touch()
        self.devices.add(path.resolve())

    def link(self, name: str, to: str) -> None:
        (self.root / name[1:]).symlink_to(to)

    def process(self, number: int, *words: str, has: str | None = None, hidden: bool = False) -> None:
        folder = self.root / f"proc/{number}"
        folder.mkdir()
        (folder / "cmdline").write_text("\0".join(words) + "\0")
        (folder / "comm").write_text(words[0].rpartition("/")[2] + "\n")
        if not hidden:
            (folder / "fd").mkdir()
            (folder / "fd/0").symlink_to("/dev/null")
            if has is not None:
                (folder / "fd/3").symlink_to(has)

    def write(self, name: str, text: str) -> None:
        path = self.root / name[1:]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def look(self, name: str = PORT) -> Finding | None:
        return before_opening(name, self.root)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_a_free_port_has_nothing_against_it(machine: Machine) -> None:
    machine.device(PORT)
    machine.link(BY_ID, "../../ttyUSB0")
    machine.process(7, "/usr/bin/other", has="/dev/ttyUSB1")
    assert machine.look() is None
    assert machine.look(BY_ID) is None


def test_an_absent_port_names_those_that_are_there(machine: Machine) -> None:
    assert machine.look() == Finding(
        "no such device; no serial port is there", "plug it in, or name the right one", True
    )
    for name in ("/dev/ttyUSB1", "/dev/ttyACM0", "/dev/ttyAMA0", "/dev/ttyS0", "/dev/tty1"):
        machine.device(name)
    machine.device("/dev/ttyprintk0")
    machine.link(BY_ID, "../../ttyUSB1")
    machine.link("/dev/serial0", "ttyAMA0")
    found = machine.look()
    assert found is not None
    assert found.text == f"no such device; there are {BY_ID}, /dev/serial0, /dev/ttyACM0"
    assert not isinstance(found.error, Unusable), "it may be plugged in"
    assert str(found.error) == f"{found.text}; to do: plug it in, or name the right one"


def test_a_program_that_has_it_is_named_whatever_the_port_is_called(machine: Machine) -> None:
    machine.device(PORT)
    machine.link(BY_ID, "../../ttyUSB0")
    machine.process(812, "/usr/bin/python3", "mavproxy.py", has=PORT)
    machine.process(os.getpid(), "/usr/bin/handfast", has=PORT)
    for name in (PORT, BY_ID):
        found = machine.look(name)
        assert found == Finding("another program has it open (process 812, python3)", "end it")
        assert isinstance(found.error, Unusable)


def test_modem_manager_is_named_with_its_remedy_and_waited_for(machine: Machine) -> None:
    machine.device(PORT)
    machine.process(50, "/usr/sbin/ModemManager", has=PORT)
    found = machine.look()
    assert found is not None
    assert found.text == "another program has it open (process 50, ModemManager)"
    assert "sudo systemctl disable --now ModemManager" in found.remedy
    assert found.transient


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("/proc/consoles", "tty0 -WU (EC p) 4:7\nttyAMA0 -W- (EC p a) 204:64\n"),
        ("/proc/cmdline", "console=serial0,115200 console=tty1 root=/dev/mmcblk0p2\n"),
    ],
)
def test_the_kernels_console_is_told(machine: Machine, file: str, text: str) -> None:
    machine.device("/dev/ttyAMA0")
    machine.link("/dev/serial0", "ttyAMA0")
    assert console_note("/dev/serial0", machine.root) == ""
    machine.write(file, text)
    note = console_note("/dev/serial0", machine.root)
    assert note.startswith("a Linux console is on it: the kernel writes there; to do: ")
    assert "remove console=ttyAMA0 (or serial0) from the kernel's cmdline.txt" in note
    assert console_note(PORT, machine.root) == ""


def test_what_is_no_port_is_told(machine: Machine) -> None:
    machine.device(PORT)
    machine.write("/dev/notes", "")
    remedy = f"name a serial port: {PORT}"
    assert machine.look("/dev/serial/by-id") == Finding("this is not a serial port", remedy)
    assert machine.look("/dev/notes") == Finding("this is not a serial port", remedy)
    found = refused("/dev/null", errno.ENOTTY, machine.root)
    assert found == Finding("this is not a serial port", remedy)


def test_a_login_on_it_is_named_with_its_remedy(machine: Machine) -> None:
    machine.device(PORT)
    machine.process(9, "/sbin/agetty", "-L", "ttyUSB0")
    found = machine.look()
    assert found is not None
    assert found.text == "a Linux console is on it (process 9, agetty)"
    assert "serial-getty@ttyUSB0" in found.remedy


def test_a_group_that_may_not_read_is_no_group_to_join(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/ttyS9").touch(0o600)
    found = refused("/dev/ttyS9", errno.EACCES, tmp_path)
    assert "lets its group not read and write" in found.text
    assert "udev" in found.remedy


def test_who_may_not_is_told_why_and_what_to_do() -> None:
    assert forbidden("ann", "dialout", mine=False, listed=False) == Finding(
        "permission denied: it is of group dialout, and ann is not in that",
        "sudo usermod -aG dialout ann, and log in again",
    )
    late = forbidden("ann", "dialout", mine=False, listed=True)
    assert "after this session began" in late.text
    assert late.remedy.startswith("log in again")
    assert "container" in forbidden("ann", "dialout", mine=True, listed=True).remedy
