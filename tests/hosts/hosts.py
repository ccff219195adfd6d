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
import pwd
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal

from tests.hosts import spaces
from tests.hosts.programs import SYSTEM_PATH, feign_old_python, hide_python, python_to_lend
from tests.hosts.spaces import HostsFailed, Space

HERE: Final = Path(__file__).parent
ROOT: Final = HERE.parents[1]
SUBNET: Final = "10.213.0"
"""Every set has the same: no two can see each other, nor this machine's networks."""
OPERATOR_ADDRESS: Final = f"{SUBNET}.1"
NOBODYS_ADDRESS: Final = f"{SUBNET}.250"
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
PROGRAMS: Final = "/run/programs/bin"
"""Where a host has programs that feign something."""
TIMEOUT_S: Final = 60.0
Result = subprocess.CompletedProcess[str]


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


@dataclass(frozen=True)
class Setup:
    """What one host is like.

    Attributes:
        systemd: whether it has a journal and the user's `systemd --user`.
        linger: whether /var/lib/systemd/linger tells that the user's manager outlives his sessions.
        python: what `python3` is: 3.11 or later (``"usual"``), 3.9 by its own word (``"old"``), or not there.
        home_mb: size of the file system that holds the home, MiB; None for this machine's disk.
    """

    systemd: bool = True
    linger: bool = True
    python: Literal["usual", "old", "none"] = "usual"
    home_mb: int | None = None


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
            self.operator: Final = Operator(self, setups)
            for number, setup in enumerate(setups, start=1):
                self._hosts.append(Host(self, number, setup))
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


class Operator:
    """The operator's computer. Its files are this machine's, but for the user's home, which is `home`.

    The home has `.ssh` with a key that all hosts admit, their host keys, and a `config` with their addresses;
    /etc/hosts has their names too. The Python under test is the one that runs the tests, first on PATH.
    """

    name: Final = "operator"
    address: Final = OPERATOR_ADDRESS

    def __init__(self, hosts: Hosts, setups: Sequence[Setup]) -> None:
        self._hosts = hosts
        self._folder = hosts.folder / self.name
        self.home: Final = self._folder / "home"
        (self.home / ".ssh").mkdir(mode=0o700, parents=True)
        self.public_key: Final = _make_key(self.home / ".ssh" / "id_ed25519")
        names = "".join(f"{_address(n)} {_name(n)}\n" for n in range(1, len(setups) + 1))
        self.etc_hosts: Final = f"127.0.0.1 localhost\n{self.address} {self.name}\n{names}"
        (self._folder / "hosts").write_text(self.etc_hosts)
        small = []
        for number, setup in enumerate(setups, start=1):
            home = hosts.folder / _name(number) / "home"
            home.mkdir(mode=0o700, parents=True)
            if setup.home_mb is not None:
                small.append(f"{setup.home_mb} {home}")
        self.environment: Final = {
            **_user(),
            "PATH": os.pathsep.join((str(Path(sys.executable).parent), SYSTEM_PATH)),
            spaces.MARK: hosts.name,
        }
        self.space: Final = Space(
            ["--mount", "--net", "--uts"],
            (HERE / "operator_inside.sh").read_text(),
            {
                **self.environment,
                "NAME": hosts.name,
                "HOME_DIR": str(self.home),
                "KEEP": "\n".join(_in_home()),
                "ETC_HOSTS": str(self._folder / "hosts"),
                "SMALL_HOMES": "\n".join(small),
                "ADDRESS": f"{self.address}/24",
            },
            self._folder / "console",
        )
        self.space.wait_ready()

    def know(self, hosts: Sequence[Host]) -> None:
        """Writes the hosts' addresses and keys into the operator's ssh settings."""
        ssh = self.home / ".ssh"
        user = pwd.getpwuid(os.geteuid()).pw_name
        (ssh / "config").write_text(
            "".join(f"Host {host.name}\n  HostName {host.address}\n  User {user}\n" for host in hosts)
        )
        known = "".join(f"{host.name},{host.address} {host.public_key}\n" for host in hosts)
        (ssh / "known_hosts").write_text(known)

    def run(
        self,
        command: Sequence[str],
        env: Mapping[str, str] | None = None,
        *,
        cwd: Path | str | None = None,
        timeout: float = TIMEOUT_S,
        input: str | None = None,
        outside: bool = False,
    ) -> Result:
        """Runs a command to its end.

        Args:
            env: added to the usual environment.
            cwd: as the operator sees it; his home when left out.
            outside: in this machine's network, with the operator's files: for what must be downloaded.
        """
        started = self.popen(command, env, cwd=cwd, outside=outside, stdin=subprocess.PIPE)
        with started:
            try:
                out, err = started.communicate(input, timeout)
            except BaseException:
                started.kill()
                raise
        return subprocess.CompletedProcess(list(command), started.returncode, out, err)

    def popen(
        self,
        command: Sequence[str],
        env: Mapping[str, str] | None = None,
        *,
        cwd: Path | str | None = None,
        outside: bool = False,
        **options: Any,
    ) -> subprocess.Popen[str]:
        """Starts a command; its pid is the command's own, so that signals reach it. Its output is piped."""
        enter = self.space.command("mount", *(() if outside else ("net", "uts")))
        names = (*INHERITED, *(INHERITED_OUTSIDE if outside else ()))
        inherited = {name: value for name, value in os.environ.items() if name.startswith(names)}
        return subprocess.Popen(
            [*enter, "env", f"--chdir={cwd or self.environment['HOME']}", *command],
            env={**inherited, **self.environment, **(env or {})},
            text=True,
            **{"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
        )

    def ssh(self, host: Host | str, command: str, *options: str, timeout: float = TIMEOUT_S) -> Result:
        """Runs a command on a host over ssh, as strictly as a script would."""
        name = host if isinstance(host, str) else host.name
        strict = ("-oBatchMode=yes", "-oStrictHostKeyChecking=yes", "-oConnectTimeout=5")
        return self.run(["ssh", *options, *strict, name, command], timeout=timeout)

    def cut(self) -> None:
        """Unplugs the operator's cable: the hosts still reach each other."""
        self.space.links("link set port0 down")

    def restore(self) -> None:
        """Plugs it in again."""
        self.space.links("link set port0 up")

    def pids(self) -> dict[int, str]:
        """Processes in the operator's network, by pid, with their command lines."""
        return {pid: _command(pid) for pid in self.space.pids("net") - {self.space.pid}}

    def end(self) -> None:
        """Kills what runs there and lets the network go."""
        for pid in self.pids():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.space.end()


class Host:
    """One host. Methods that begin with `power_` are the only ones that work while it is off."""

    def __init__(self, hosts: Hosts, number: int, setup: Setup) -> None:
        self._hosts = hosts
        self._operator = hosts.operator
        self._port = f"port{number}"
        self._cut = False
        self._space: Space | None = None
        self.name: Final = _name(number)
        self.address: Final = _address(number)
        self._mac = f"02:00:00:00:00:{number:02x}"  # stays the same over a reboot, as a real device's does
        self.setup: Final = setup
        self.folder: Final = hosts.folder / self.name
        uid = os.geteuid()
        lent = python_to_lend() if setup.python == "usual" else None
        path = {
            "usual": f"{lent}/bin{os.pathsep}{SYSTEM_PATH}" if lent else SYSTEM_PATH,
            "old": f"{PROGRAMS}{os.pathsep}{SYSTEM_PATH}",
            "none": PROGRAMS,
        }[setup.python]
        session = {
            "XDG_RUNTIME_DIR": f"/run/user/{uid}",
            "DBUS_SESSION_BUS_ADDRESS": f"unix:path=/run/user/{uid}/bus",
        }
        self.environment: Final = {
            **_user(),
            "PATH": path,
            **(session if setup.systemd else {}),
            spaces.MARK: hosts.name,
        }
        self._begin_with = {
            **self.environment,
            "PATH": SYSTEM_PATH,
            "HOST_PATH": path,
            "NAME": self.name,
            "FOLDER": str(self.folder),
            "GROUP": f"{hosts.name}-{self.name}",
            "PYTHON_FOLDER": str(lent or ""),
            "SYSTEMD": "yes" if setup.systemd else "no",
        }
        self._furnish()

    def _furnish(self) -> None:
        """Writes what is the host's own of /etc, and the other folders that outlive a reboot."""
        for name in ("log", "systemd/linger", "programs", "python"):
            (self.folder / name).mkdir(parents=True)
        (self.folder / "log" / "journal").mkdir()  # so the journal outlives a reboot, as Debian's does
        if self.setup.linger:
            (self.folder / "systemd" / "linger" / self.environment["USER"]).touch()
        if self.setup.python == "none":
            hide_python(self.folder / "programs")
        elif self.setup.python == "old":
            feign_old_python(self.folder / "programs")
        etc = self.folder / "etc"
        subprocess.run(["cp", "-a", "/etc", etc], check=True)
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
        self.public_key = _make_key(ssh / "host_key")
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
        group = f"/sys/fs/cgroup/user.slice/user-{os.geteuid()}.slice/session-1.scope/cgroup.procs"
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
        found = {pid: _command(pid) for pid in self.space.pids("pid") - {self.space.pid}}
        return {pid: line for pid, line in found.items() if line and words in line and not _of_the_host(line)}

    # --- faults -----------------------------------------------------------------------------------

    def cut(self) -> None:
        """Unplugs its cable."""
        self._cut = True
        self._operator.space.links(f"link set {self._port} down")

    def restore(self) -> None:
        """Plugs it in again."""
        self._cut = False
        self._operator.space.links(f"link set {self._port} up")

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

    def fill_disk(self) -> None:
        """Fills its home to the last byte; needs `home_mb`."""
        assert self.setup.home_mb is not None, "only a home of limited size can be filled"
        self.run("cat /dev/zero >.filling 2>/dev/null")

    def free_disk(self) -> None:
        """Takes that away again."""
        self.run("rm -f .filling", check=True)


INHERITED: Final = ("HANDFAST_TEST_PROCESS", "TERM")
"""How variables begin that commands of the operator take from the test run: whose process it is, for one."""
INHERITED_OUTSIDE: Final = ("PIP_", "UV_", "SSL_CERT", "HTTPS_PROXY", "https_proxy", "NO_PROXY", "no_proxy")
"""And those for downloads."""


def _name(number: int) -> str:
    return f"host{number}"


def _address(number: int) -> str:
    return f"{SUBNET}.{10 + number}"


def _user() -> dict[str, str]:
    """The variables that a login sets."""
    user = pwd.getpwuid(os.geteuid())
    return {
        "HOME": user.pw_dir,
        "USER": user.pw_name,
        "LOGNAME": user.pw_name,
        "SHELL": "/bin/bash",
        "LANG": "C.UTF-8",
    }


def _in_home() -> list[str]:
    """Folders of the real home that the tests and the Python under test need, outermost only."""
    home = Path(pwd.getpwuid(os.geteuid()).pw_dir)
    needed = [str(ROOT), tempfile.gettempdir(), sys.prefix, sys.base_prefix, *filter(os.path.isdir, sys.path)]
    inside = {path for path in map(Path, needed) if path.is_relative_to(home) and path != home}
    return sorted(str(path) for path in inside if not inside & set(path.parents))


def _make_key(path: Path) -> str:
    """Makes a pair of ssh keys; returns the public one, without its comment."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", path], check=True)
    return " ".join(path.with_suffix(".pub").read_text().split()[:2])


def _command(pid: int) -> str:
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return ""
    return line.replace(b"\0", b" ").decode(errors="replace").strip()


def _of_the_host(line: str) -> bool:
    parts = (
        "sshd:",
        "/usr/sbin/sshd",
        "/lib/systemd/",
        "/usr/lib/systemd/",
        "/usr/bin/dbus-daemon",
        "(sd-pam)",
    )
    return line.startswith(parts)
