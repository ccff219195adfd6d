"""One test host, all real to what runs on it: its power, what is done in it, and what befalls it."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.hosts import spaces
from tests.hosts.computers import (
    HERE,
    TIMEOUT_S,
    USER,
    USER_ID,
    Result,
    command_line,
    host_address,
    host_name,
    login_variables,
    login_variables_of,
    make_key,
)
from tests.hosts.operator_computer import Operator
from tests.hosts.programs import SYSTEM_PATH, hide_python, python_to_lend
from tests.hosts.spaces import HostsFailed, Space

WITHOUT_NAMESPACES: Final = HERE / "without_namespaces.py"
GROUPS: Final = ("dialout", "systemd-journal")
"""Of the ordinary user of a host, beside his own."""
PROGRAMS: Final = "/run/programs/bin"
"""Where a host has programs that feign something."""
_OF_THE_HOST: Final = (
    "sshd:",
    "/usr/sbin/sshd",
    "/lib/systemd/",
    "/usr/lib/systemd/",
    "/usr/bin/dbus-daemon",
    "(sd-pam)",
)
"""How command lines begin of what a host is made of."""


@dataclass(frozen=True)
class Setup:
    """What one host is like.

    Attributes:
        systemd: whether it has a journal and the user's `systemd --user`.
        linger: whether /var/lib/systemd/linger tells that the user's manager outlives his sessions.
        has_python: whether it has a `python3`, of 3.11 or later.
        home_mb: size of the file system that holds the home, MiB; None for this machine's disk.
        ordinary: whether the user whose home it is, and who is logged in to, is not root: then one of the
            name `USER`, in the group of serial ports. `Host.run` is root's all the same.
        namespaces: whether the user's units can have any of their own.
    """

    systemd: bool = True
    linger: bool = True
    has_python: bool = True
    home_mb: int | None = None
    ordinary: bool = False
    namespaces: bool = True


class Host:
    """One host. Methods that begin with `power_` are the only ones that work while it is off.

    Args:
        operator: whose bridge it is joined to.
        number: from 1.
        setup: what it is like.
    """

    def __init__(self, operator: Operator, number: int, setup: Setup) -> None:
        self._operator = operator
        self._port = f"port{number}"
        self._cut = False
        self._space: Space | None = None
        self.name: Final = host_name(number)
        self.address: Final = host_address(number)
        self._mac = f"02:00:00:00:00:{number:02x}"  # stays the same over a reboot, as a real device's does
        self.setup: Final = setup
        self.folder: Final = operator.set_folder / self.name
        self.uid: Final = USER_ID if setup.ordinary else os.geteuid()
        lent = python_to_lend() if setup.has_python else None
        path = f"{lent}/bin{os.pathsep}{SYSTEM_PATH}" if lent else SYSTEM_PATH
        if not setup.has_python:
            path = PROGRAMS
        session = {
            "XDG_RUNTIME_DIR": f"/run/user/{self.uid}",
            "DBUS_SESSION_BUS_ADDRESS": f"unix:path=/run/user/{self.uid}/bus",
        }
        self.environment: Final = {
            **(login_variables_of(USER) if setup.ordinary else login_variables()),
            "PATH": path,
            **(session if setup.systemd else {}),
            spaces.MARK: operator.set_name,
        }
        self._begin_with = {
            **self.environment,
            "PATH": SYSTEM_PATH,
            "HOST_PATH": path,
            "NAME": self.name,
            "FOLDER": str(self.folder),
            "GROUP": f"{operator.set_name}-{self.name}",
            "PYTHON_FOLDER": str(lent or ""),
            "SYSTEMD": "yes" if setup.systemd else "no",
            "OWNER": str(self.uid),
            "WITHOUT_NAMESPACES": "" if setup.namespaces else f"/run/programs/{WITHOUT_NAMESPACES.name}",
        }
        self._furnish()

    def _furnish(self) -> None:
        """Writes what is the host's own of /etc, and the other folders that outlive a reboot."""
        for name in ("log", "systemd/linger", "programs", "python"):
            (self.folder / name).mkdir(parents=True)
        shutil.copy(WITHOUT_NAMESPACES, self.folder / "programs")
        (self.folder / "log" / "journal").mkdir()  # so the journal outlives a reboot, as Debian's does
        if self.setup.linger:
            (self.folder / "systemd" / "linger" / self.environment["USER"]).touch()
        if not self.setup.has_python:
            hide_python(self.folder / "programs")
        etc = self.folder / "etc"
        subprocess.run(["cp", "-a", "/etc", etc], check=True)
        if self.setup.ordinary:
            _add_user(etc)
        (etc / "hostname").write_text(f"{self.name}\n")
        (etc / "machine-id").unlink(missing_ok=True)
        (etc / "machine-id").write_text(f"{os.urandom(16).hex()}\n")
        (etc / "hosts").unlink(missing_ok=True)
        (etc / "hosts").write_text(self._operator.etc_hosts)
        (etc / "systemd").mkdir(exist_ok=True)
        (etc / "systemd" / "journald.conf").write_text(
            "[Journal]\nStorage=persistent\nReadKMsg=no\nRateLimitBurst=0\n"
        )
        ssh = etc / "ssh"
        shutil.rmtree(ssh, ignore_errors=True)
        ssh.mkdir()
        self.public_key = make_key(ssh / "host_key")
        (ssh / "authorized_keys").write_text(f"{self._operator.public_key}\n")
        environment = " ".join(
            f"{name}={value}" for name, value in self.environment.items() if name != "HOME"
        )
        (ssh / "sshd_config").write_text(
            "KexAlgorithms curve25519-sha256\n"  # the default's takes a slow machine 0.3 s more
            "UsePAM no\n"  # no session of logind's could be opened: SetEnv gives what it would
            "PasswordAuthentication no\n"
            "PermitRootLogin prohibit-password\n"
            "StrictModes no\n"
            "UseDNS no\n"
            "HostKey /etc/ssh/host_key\n"
            "AuthorizedKeysFile /etc/ssh/authorized_keys\n"
            "Subsystem sftp internal-sftp\n"
            f"SetEnv {environment}\n"
        )

    # --- power ------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Starts it, without waiting."""
        self._space = Space(
            ["--mount", "--net", "--uts", "--ipc", "--pid", "--fork", "--kill-child", "--mount-proc"],
            (HERE / "host_inside.sh").read_text(),
            self._begin_with,
            self.folder / "console",
            within=self._operator.space,
        )

    def connect(self) -> None:
        """Gives it its network device, joined to the bridge."""
        self.space.wait_inside()
        self._operator.space.links(
            f"link add {self._port} type veth peer name eth0 netns {self.space.pid} address {self._mac}\n"
            f"link set {self._port} master br0 {'down' if self._cut else 'up'}\n"
        )
        self.space.links(f"address add {self.address}/24 dev eth0\nlink set eth0 up\n")

    def wait_ready(self) -> None:
        """Until ssh and the user's systemd answer."""
        self.space.wait_ready()

    def power_on(self) -> None:
        """Starts it, with the home and the journal that it had; ready when this returns."""
        self.begin()
        self.connect()
        self.wait_ready()

    def power_off(self) -> None:
        """Kills everything in it at once, like a power cut; its control groups go with it."""
        if self._space is None:
            return
        space, self._space = self._space, None
        with contextlib.suppress(HostsFailed):  # it has none yet when it failed to start
            self._operator.space.links(f"link del {self._port}")
        space.end()
        with spaces.control_groups() as groups:
            spaces.remove_group(groups / self._begin_with["GROUP"], time.monotonic() + spaces.STOP_S)

    def reboot(self) -> None:
        """A power cut, and on again."""
        self.power_off()
        self.power_on()

    @property
    def space(self) -> Space:
        """Its namespaces, as long as it is on."""
        assert self._space is not None, f"{self.name} is off"
        return self._space

    # --- what is done in it -----------------------------------------------------------------------

    def run(
        self,
        command: str | Sequence[str],
        env: Mapping[str, str] | None = None,
        *,
        timeout: float = TIMEOUT_S,
        input: str | None = None,
        check: bool = False,
    ) -> Result:
        """Runs a command in its home, with the environment of an ssh session, but not through the network."""
        text = command if isinstance(command, str) else shlex.join(command)
        group = f"/sys/fs/cgroup/user.slice/user-{self.uid}.slice/session-1.scope/cgroup.procs"
        return subprocess.run(
            [
                *self.space.command("mount", "net", "uts", "ipc", "pid", "cgroup"),
                *("bash", "-c", f'cd && echo 0 >{group} && exec bash -c "$1"', "bash", text),
            ],
            env={**self.environment, **(env or {})},
            stdin=subprocess.DEVNULL if input is None else None,
            input=input,
            text=True,
            capture_output=True,
            timeout=timeout,
            check=check,
        )

    @property
    def home(self) -> Path:
        """Its home as this machine sees it; only while it is on."""
        return Path(f"/proc/{self.space.pid}/root{self.environment['HOME']}")

    def pids(self, words: str = "") -> dict[int, str]:
        """Its processes whose command line has these words, by pid as this machine counts, with that line.

        Left out is what the host itself is made of: sshd, systemd and the journal.
        """
        found = {pid: command_line(pid) for pid in self.space.pids("pid") - {self.space.pid}}
        return {
            pid: line
            for pid, line in found.items()
            if line and words in line and not line.startswith(_OF_THE_HOST)
        }

    # --- faults -----------------------------------------------------------------------------------

    def cut(self) -> None:
        """Takes it out of range: nothing gets through, either way, and nobody is told.

        A cable that is pulled would tell the kernel, which then takes up to a second of its own before it
        sends anything over one that is back: Linux looks at links that come and go once a second.
        """
        self._cut = True
        self._operator.space.forward(self._port, through=False)

    def restore(self) -> None:
        """Brings it back into range."""
        self._cut = False
        self._operator.space.links(f"link set {self._port} up")  # down, where it was switched on meanwhile
        self._operator.space.forward(self._port, through=True)

    def stop_sshd(self) -> None:
        """Ends its sshd and the sessions of it."""
        self.run("pkill -x sshd; while pgrep -x sshd >/dev/null; do sleep 0.01; done", check=True)

    def start_sshd(self) -> None:
        """Starts it again."""
        self.run("/usr/sbin/sshd", check=True)

    def wrong_host_key(self) -> None:
        """Gives it a host key that the operator does not know, as after a new installation."""
        self.stop_sshd()
        self.run("rm /etc/ssh/host_key* && ssh-keygen -q -t ed25519 -N '' -f /etc/ssh/host_key", check=True)
        self.start_sshd()


def _add_user(etc: Path) -> None:
    """Gives a host's /etc the ordinary user, who may open serial ports and read the journal."""
    with (etc / "passwd").open("a") as users:
        users.write(f"{USER}:x:{USER_ID}:{USER_ID}::/home/{USER}:/bin/bash\n")
    groups = [line.split(":") for line in (etc / "group").read_text().splitlines()]
    groups = [
        [name, x, number, ",".join(filter(None, [members, USER if name in GROUPS else ""]))]
        for name, x, number, members in groups
    ]
    lines = [":".join(group) for group in [*groups, [USER, "x", str(USER_ID), ""]]]
    (etc / "group").write_text("\n".join(lines) + "\n")
