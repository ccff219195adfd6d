"""Computers for tests: an operator's and some hosts, all real to what runs on them, on this machine.

Each host has a network of its own (joined to the others by a bridge), a home, an sshd with its own
key, a journal and a `systemd --user`; it shares this machine's /usr, kernel and clock. The operator's
computer has this machine's files and its own home, with what ssh needs to know the hosts:

    with Hosts(3) as hosts:
        done = hosts.operator.run(["handfast", "up", "fleet.toml"])
        hosts[0].cut()

Needs root; `missing` tells what else. Nothing in it can reach this machine's networks.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final

from tests.hosts import spaces
from tests.hosts.host import Host, Setup
from tests.hosts.operator_computer import Operator
from tests.hosts.programs import SYSTEM_PATH

TOOLS: Final = {
    "ip": "iproute2",
    "ssh": "openssh-client",
    "/usr/sbin/sshd": "openssh-server",
    "/lib/systemd/systemd": "systemd",
    "/usr/lib/systemd/user/dbus.socket": "dbus-user-session",
    "pkill": "procps",
    "unshare": "util-linux",
    "nsenter": "util-linux",
    "setsid": "util-linux",
}


def missing() -> str | None:
    """Why test hosts cannot be made here, in one line; None when they can."""
    if not sys.platform.startswith("linux"):
        return "test hosts need Linux"
    if os.geteuid() != 0:
        return "test hosts need root"
    lacking = {
        package
        for tool, package in TOOLS.items()
        if not (Path(tool).exists() if "/" in tool else shutil.which(tool, path=SYSTEM_PATH))
    }
    return f"test hosts need the packages {', '.join(sorted(lacking))}" if lacking else None


class Hosts:
    """A set of test hosts and their operator; a context manager, which removes all of it at the end.

    Args:
        hosts: how many, or what each is like. Their names are ``host1``, ``host2``, ...

    Raises:
        HostsFailed: when one does not start; what it printed is in the text.
    """

    def __init__(self, hosts: int | Sequence[Setup]) -> None:
        setups = [Setup()] * hosts if isinstance(hosts, int) else list(hosts)
        spaces.sweep()
        self.name: Final = spaces.run_name()
        self.folder: Final = Path(tempfile.gettempdir()) / self.name
        self.folder.mkdir(mode=0o700)
        with contextlib.ExitStack() as stack:
            stack.callback(self.close)
            self._hosts: list[Host] = []
            self.operator: Final = Operator(self.name, self.folder, setups)
            for number, setup in enumerate(setups, start=1):
                self._hosts.append(Host(self.operator, number, setup))
            self.operator.know(self._hosts)
            for host in self._hosts:
                host.begin()
            for host in self._hosts:
                host.connect()
            for host in self._hosts:
                host.wait_ready()
            stack.pop_all()

    def close(self) -> None:
        """Removes everything, or raises HostsFailed; a second call does nothing."""
        if not self.folder.exists():
            return
        with contextlib.ExitStack() as stack:  # one that fails keeps none of the others
            stack.callback(spaces.remove_rest, self.name)
            if hasattr(self, "operator"):
                stack.callback(self.operator.end)
            for host in self._hosts:
                stack.callback(host.power_off)

    def __enter__(self) -> Hosts:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._hosts)

    def __getitem__(self, index: int) -> Host:
        return self._hosts[index]

    def __iter__(self) -> Iterator[Host]:
        return iter(self._hosts)
