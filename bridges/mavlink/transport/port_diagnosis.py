"""Says why a serial port is of no use, and what to do.

The port may be absent, taken, a console's, forbidden, or no port. Bytes that come may be of another speed, or
from something that speaks no MAVLink.
"""

from __future__ import annotations

import errno
import grp
import os
import pwd
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.transport.connection_string import Unusable

TO_DO: Final = "; to do: "
"""Between what is wrong and what to do about it."""
ROOT: Final = Path("/")
PORTS: Final = (
    "dev/serial/by-id/*",
    "dev/serial[0-9]*",
    "dev/ttyUSB*",
    "dev/ttyACM*",
    "dev/ttyAMA*",
    "dev/ttyTHS*",
)
PORTS_SHOWN: Final = 6
CONSOLE: Final = "a Linux console is on it"
MODEM_MANAGER: Final = "ModemManager"
_MODEM: Final = (
    f"{MODEM_MANAGER} takes every new port for a modem and lets go after some seconds: "
    f"sudo systemctl disable --now {MODEM_MANAGER}"
)


class Finding(NamedTuple):
    """What is wrong with a port, and what to do about it.

    Attributes:
        transient: it may end by itself.
    """

    text: str
    remedy: str
    transient: bool = False

    @property
    def error(self) -> OSError:
        """As opening a channel raises it."""
        return (OSError if self.transient else Unusable)(f"{self.text}{TO_DO}{self.remedy}")


def before_opening(device: str, root: Path = ROOT) -> Finding | None:
    """What can be seen without opening it; None: nothing speaks against that.

    Args:
        root: where /dev, /proc and /sys are.
    """
    try:
        status = (root / device[1:]).stat()
    except PermissionError:
        return refused(device, errno.EACCES, root)
    except OSError:
        return refused(device, errno.ENOENT, root)
    kind = root / f"sys/dev/char/{os.major(status.st_rdev)}:{os.minor(status.st_rdev)}/subsystem"
    if not stat.S_ISCHR(status.st_mode) or (kind.exists() and kind.resolve().name != "tty"):
        return refused(device, errno.ENOTTY, root)
    holders = list(_holders(device, root))
    return _taken(device, holders, root) if holders else None


def refused(device: str, number: int, root: Path = ROOT) -> Finding:
    """Why opening it failed, with that `errno`; EAGAIN: another program has its lock."""
    there = list(_ports(root))
    named = ", ".join(there[:PORTS_SHOWN]) or "none is there"
    if number == errno.EACCES:
        return _forbidden(root / device[1:])
    if number == errno.EPERM:
        return Finding("what this runs in, a container or a service, keeps it away", "let it have the device")
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EIO):
        text = f"no such device; there are {named}" if there else "no such device; no serial port is there"
        return Finding(text, "plug it in, or name the right one", True)
    if number in (errno.EBUSY, errno.EAGAIN):
        return _taken(device, list(_holders(device, root)), root)
    if number in (errno.ENOTTY, errno.EINVAL):
        return Finding("this is not a serial port", f"name a serial port: {named}")
    return Finding(os.strerror(number).lower(), "check the device")


def console_note(device: str, root: Path = ROOT) -> str:
    """What to do when the kernel's own messages go to a port; "" when they do not."""
    consoles = {line.split()[0] for line in _text(root / "proc/consoles").splitlines() if line.split()}
    words = _text(root / "proc/cmdline").split()
    consoles |= {word[8:].partition(",")[0] for word in words if word.startswith("console=")}
    path = root / device[1:]
    if consoles.isdisjoint({path.name, path.resolve().name}):
        return ""
    return f"{CONSOLE}: the kernel writes there{TO_DO}{_console_off(device, root)}"


def _ports(root: Path) -> Iterator[str]:
    """The serial ports that are there, each by its best name."""
    seen = set()
    for pattern in PORTS:
        for path in sorted(root.glob(pattern)):
            if path.exists() and path.resolve() not in seen:
                seen.add(path.resolve())
                yield f"/{path.relative_to(root)}"


def _holders(device: str, root: Path) -> Iterator[tuple[int, str]]:
    """Processes that have it open, and their commands, of those that may be looked at; and gettys on it."""
    path = (root / device[1:]).resolve()
    target = f"/{path.relative_to(root.resolve())}"
    for folder in (root / "proc").glob("[0-9]*"):
        words = _text(folder / "cmdline").split("\0")
        command = os.path.basename(words[0]).lstrip("-") or _text(folder / "comm").strip()
        try:
            handles = [os.readlink(handle) for handle in (folder / "fd").iterdir()]
        except OSError:
            handles = []  # another user's, or gone
        is_getty = command.endswith("getty") and path.name in words[1:]
        if int(folder.name) != os.getpid() and (is_getty or target in handles):
            yield int(folder.name), command


def _taken(device: str, holders: list[tuple[int, str]], root: Path) -> Finding:
    commands = [command for _, command in holders]
    if not holders and any(_text(f).strip() == MODEM_MANAGER for f in (root / "proc").glob("[0-9]*/comm")):
        commands = [MODEM_MANAGER]
    named = "; ".join(f"process {process}, {command}" for process, command in holders)
    text = f"another program has it open ({named})" if named else "another user's program has it open"
    if MODEM_MANAGER in commands:
        return Finding(text, _MODEM, True)
    if any(command.endswith("getty") or command == "login" for command in commands):
        return Finding(f"{CONSOLE} ({named})", _console_off(device, root))
    return Finding(text, "end it" if named else f"sudo fuser -v {device} says which: end it")


def _console_off(device: str, root: Path) -> str:
    name = (root / device[1:]).resolve().name
    return (
        f"sudo systemctl disable --now serial-getty@{name}, remove console={name} (or serial0) from the "
        "kernel's cmdline.txt, and restart (Raspberry Pi: raspi-config, serial port, no login shell)"
    )


def _forbidden(path: Path) -> Finding:
    try:
        state = path.stat()
        user, group = pwd.getpwuid(os.geteuid()).pw_name, grp.getgrgid(state.st_gid)
    except (OSError, KeyError):
        return Finding("permission denied", "give this user the device, or the folder that it is in")
    if state.st_mode & 0o060 != 0o060:
        return Finding(
            f"permission denied: its mode, {stat.filemode(state.st_mode)}, lets its group not read and write",
            "give its group rw by a rule of udev",
        )
    mine = state.st_gid in {os.getegid(), *os.getgroups()}
    return forbidden(user, group.gr_name, mine=mine, listed=user in group.gr_mem)


def forbidden(user: str, group: str, *, mine: bool, listed: bool) -> Finding:
    """Why a user may not open a device of a group.

    Args:
        mine: this process is of the group. listed: the user is, in the system's list.
    """
    if mine:
        return Finding(
            f"permission denied, though {user} is in its group, {group}",
            "let the container or the service that this runs in have the device",
        )
    if listed:
        return Finding(
            f"permission denied: {user} was put into its group, {group}, after this session began",
            "log in again (a service: restart it)",
        )
    return Finding(
        f"permission denied: it is of group {group}, and {user} is not in that",
        f"sudo usermod -aG {group} {user}, and log in again",
    )


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


PATIENCE_NS: Final = 3 * NS_PER_S
"""Bytes may come for so long without a message among them."""
GOOD_NS: Final = NS_PER_S
"""After a message it is not looked for another for so long: it costs next to nothing when all is well."""
QUIET_NS: Final = 2 * NS_PER_S
BYTES_MIN: Final = 16
"""Fewer are no evidence."""
TEXT_SHARE: Final = 0.95
TEXT_SHOWN: Final = 40
KEPT: Final = 1024
_START: Final = re.compile(rb"[\xfd\xfe]")
_LONGEST: Final = 280
_V1, _V2 = 0xFE, 0xFD
_RADIO: Final = (dialect.MAVLINK_MSG_ID_RADIO, dialect.MAVLINK_MSG_ID_RADIO_STATUS)
_PROMPT: Final = re.compile(rb"login: ?|[Pp]assword: ?|Login incorrect|[$#] $")
_TEXT: Final = frozenset((*b"\t\r\n\x1b", *range(0x20, 0x7F)))
USUAL: Final = "57600, 115200 and 921600 are usual"


def first_message(data: bytes) -> tuple[int, int] | None:
    """Version (1 or 2) and id of the first MAVLink message in `data` with a good checksum; None: none."""
    for match in _START.finditer(data):
        at = match.start()
        head = 10 if data[at] == _V2 else 6
        if at + head > len(data):
            continue
        end = at + head + data[at + 1]
        number = int.from_bytes(data[at + 7 : at + 10], "little") if head == 10 else data[at + 5]
        kind = dialect.mavlink_map.get(number)
        if kind is None or end + 2 > len(data):
            continue
        crc = dialect.x25crc(data[at + 1 : end] + bytes([kind.crc_extra])).crc
        if crc == int.from_bytes(data[end : end + 2], "little"):
            return (2 if head == 10 else 1), number
    return None


class LineContents:
    """Takes what comes in at `baud`.

    Attributes:
        trouble: why it is of no use, "" when it is MAVLink, or nothing comes.
        note: what is odd though it is MAVLink, "" when nothing is.
    """

    def __init__(self, baud: int) -> None:
        self._baud = baud
        self._kept = b""
        self._good_ns = self._since_ns = self._last_ns = self._first_ns = -PATIENCE_NS
        self._bytes = 0
        self.trouble = self.note = ""

    def take(self, now_ns: int, data: bytes) -> None:
        """Bytes that came now."""
        if 0 <= now_ns - self._good_ns < GOOD_NS:
            return
        self.look(now_ns)
        self._last_ns = now_ns
        if not self._bytes:
            self._since_ns = now_ns
        self._bytes += len(data)
        searched = self._kept[-_LONGEST:] + data
        self._kept = (self._kept + data)[-KEPT:]
        found = first_message(searched)
        if found is not None:
            self._good(now_ns, *found)
        elif now_ns - self._since_ns >= PATIENCE_NS and self._bytes >= BYTES_MIN:
            self.trouble = self._what()

    def look(self, now_ns: int) -> None:
        """Time has passed: what came long ago says nothing of the line any more."""
        if self._bytes and now_ns - self._last_ns >= QUIET_NS:
            self._bytes, self._kept, self.trouble = 0, b"", ""

    def _good(self, now_ns: int, version: int, number: int) -> None:
        self._good_ns, self._bytes, self._kept, self.trouble = now_ns, 0, b"", ""
        if version == 2:
            self._first_ns, self.note = -PATIENCE_NS, ""
        elif number not in _RADIO:  # a radio's own may be of either version
            if self._first_ns < 0:
                self._first_ns = now_ns
            elif now_ns - self._first_ns >= PATIENCE_NS:
                self.note = (
                    f"it speaks MAVLink 1{TO_DO}SERIALx_PROTOCOL = 2 for the autopilot's port, and restart it"
                )

    def _what(self) -> str:
        kept = self._kept
        if sum(byte in _TEXT for byte in kept) < TEXT_SHARE * len(kept):
            return (
                f"bytes come at {self._baud} baud, but no MAVLink: another speed?{TO_DO}give SERIALx_BAUD of "
                f"the autopilot's port and baud in the fleet file the same speed ({USUAL})"
            )
        lines = [line.strip() for line in kept.splitlines() if line.strip()]
        said = "".join(map(chr, lines[-1][:TEXT_SHOWN] if lines else b"")).replace("\x1b", "")
        if _PROMPT.search(kept):
            return (
                f"{CONSOLE}: it says {said!r}{TO_DO}end the login at its other end, or name the autopilot's "
                "port (Raspberry Pi: raspi-config, serial port, no login shell)"
            )
        if said.startswith("$G"):
            return f"a GPS is on it: it says {said!r}{TO_DO}name the autopilot's port"
        return (
            f"text comes, no MAVLink: {said!r}{TO_DO}SERIALx_PROTOCOL = 2 for the autopilot's port, or name "
            "that: this may be a console"
        )
