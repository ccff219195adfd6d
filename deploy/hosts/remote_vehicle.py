"""What runs on a robot's computer for the vehicle that is joined to it, beside `deploy.hosts.remote_program`.

It is sent along when it is needed (`deploy.hosts.connection.HostConnection.extend`), and imports nothing but
the standard library and that program.
"""

from __future__ import annotations

import grp
import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from handfast.deploy.hosts.remote_program import request

PORTS: Final = ("serial/by-id/*", "serial[0-9]*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyTHS*")
"""What there may be a vehicle at, below /dev."""
PORTS_MAX: Final = 8


@request
def ports(paths: list[str]) -> dict[str, dict[str, Any]]:
    """What can be told of serial ports by looking, without opening one, by path: see `port`."""
    return {path: port(path) for path in paths}


def port(path: str, dev: str = "/dev", proc: str = "/proc") -> dict[str, Any]:
    """What can be told of one port.

    Returns `there`: the ports that are there instead, where it is not; `kind`: what it is, where it is no
    port; `denied`: the group that may use it, and this user may not ("" none may); `late`: that group, where
    the user's systemd began before the user was in it; `console`: the console or login that is on it;
    `modem`: whether ModemManager runs, which asks USB ports whether they are modems. What is well is left
    out.
    """
    try:
        about = os.stat(path)
    except OSError:
        return {"there": others(dev)}
    if not stat.S_ISCHR(about.st_mode):
        return {"kind": "a folder" if stat.S_ISDIR(about.st_mode) else "a file"}
    found: dict[str, Any] = {}
    if not os.access(path, os.R_OK | os.W_OK):
        shared = about.st_mode & 0o060 == 0o060
        found["denied"] = group_name(about.st_gid) if shared else ""
    elif os.getuid() not in (0, about.st_uid) and about.st_mode & 0o006 != 0o006:
        began = manager_groups(proc)
        if began is not None and about.st_gid not in began:
            found["late"] = group_name(about.st_gid)
    name = os.path.basename(os.path.realpath(path))
    if taken := console(name, path, proc):
        found["console"] = taken
    if name.startswith(("ttyACM", "ttyUSB")) and any(running("ModemManager", proc)):
        found["modem"] = True
    return found


def others(dev: str) -> list[str]:
    """Ports that are there; one with several names by the first of them, which stays with it."""
    first: dict[str, str] = {}
    for pattern in PORTS:
        for found in sorted(Path(dev).glob(pattern)):
            first.setdefault(os.path.realpath(found), str(found))
    return list(first.values())[:PORTS_MAX]


def group_name(number: int) -> str:
    """Name of a group, or its number."""
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def manager_groups(proc: str) -> set[int] | None:
    """Groups that this user's systemd has, and so its units; None where it is not found."""
    for folder in running("systemd", proc):
        with suppress(OSError, ValueError):
            if folder.stat().st_uid != os.getuid() or b"--user" not in (folder / "cmdline").read_bytes():
                continue
            told = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
            return {int(number) for name in ("Groups", "Gid") for number in told[name].split()}
    return None


def running(name: str, proc: str) -> Iterator[Path]:
    """The processes of that name."""
    for folder in Path(proc).glob("[0-9]*"):
        with suppress(OSError):
            if (folder / "comm").read_text().strip() == name:
                yield folder


def console(name: str, path: str, proc: str) -> str:
    """What of the system speaks on a port, by its name below /dev; "" nothing."""
    with suppress(OSError):
        if any(line.split()[:1] == [name] for line in Path(proc, "consoles").read_text().splitlines()):
            return "the kernel's console"
    for getty in (*running("agetty", proc), *running("getty", proc)):
        with suppress(OSError):
            words = os.fsdecode((getty / "cmdline").read_bytes()).split("\0")
            if {name, path, os.path.basename(path), f"/dev/{name}"} & set(words):
                return "a login"
    return ""
