"""The operator's computer of a set of test hosts: it reaches them over ssh, and its bridge joins them."""

from __future__ import annotations

import contextlib
import os
import pwd
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tests.hosts import spaces
from tests.hosts.computers import (
    HERE,
    OPERATOR_ADDRESS,
    ROOT,
    TIMEOUT_S,
    Result,
    command_line,
    host_address,
    host_name,
    login_variables,
    make_key,
)
from tests.hosts.programs import SYSTEM_PATH
from tests.hosts.spaces import Space

if TYPE_CHECKING:
    from tests.hosts.host import Host, Setup

INHERITED: Final = ("HANDFAST_TEST_PROCESS", "TERM")
"""How variables begin that commands of the operator take from the test run: whose process it is, for one."""
INHERITED_OUTSIDE: Final = ("PIP_", "UV_", "SSL_CERT", "HTTPS_PROXY", "https_proxy", "NO_PROXY", "no_proxy")
"""And those for downloads."""


class Operator:
    """The operator's computer. Its files are this machine's, but for the user's home, which is `home`.

    The home has `.ssh` with a key that all hosts admit, their host keys, and a `config` with their addresses;
    /etc/hosts has their names too. The Python under test is the one that runs the tests, first on PATH.

    Args:
        set_name: marks all that belongs to the set of hosts.
        set_folder: where the set keeps its files.
        setups: what each host is like.
    """

    name: Final = "operator"
    address: Final = OPERATOR_ADDRESS

    def __init__(self, set_name: str, set_folder: Path, setups: Sequence[Setup]) -> None:
        self.set_name: Final = set_name
        self.set_folder: Final = set_folder
        self._folder = set_folder / self.name
        self._started: Final[list[subprocess.Popen[str]]] = []
        self.home: Final = self._folder / "home"
        (self.home / ".ssh").mkdir(mode=0o700, parents=True)
        # Runs and drives of one computer find each other in its folder for temporary files: a set of hosts
        # whose fleet has the same name, and hosts of the same addresses, is another one's.
        temporary = self._folder / "tmp"
        temporary.mkdir(mode=0o700)
        self.public_key: Final = make_key(self.home / ".ssh" / "id_ed25519")
        names = "".join(f"{host_address(n)} {host_name(n)}\n" for n in range(1, len(setups) + 1))
        self.etc_hosts: Final = f"127.0.0.1 localhost\n{self.address} {self.name}\n{names}"
        (self._folder / "hosts").write_text(self.etc_hosts)
        small = []
        for number, setup in enumerate(setups, start=1):
            home = set_folder / host_name(number) / "home"
            home.mkdir(mode=0o700, parents=True)
            if setup.home_mb is not None:
                small.append(f"{setup.home_mb} {home}")
        self.environment: Final = {
            **login_variables(),
            "PATH": os.pathsep.join((str(Path(sys.executable).parent), SYSTEM_PATH)),
            "TMPDIR": str(temporary),
            spaces.MARK: set_name,
        }
        self.space: Final = Space(
            ["--mount", "--net", "--uts"],
            (HERE / "operator_inside.sh").read_text(),
            {
                **self.environment,
                "NAME": set_name,
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
        (ssh / "config").write_text(
            "".join(
                f"Host {host.name}\n  HostName {host.address}\n  User {host.environment['USER']}\n"
                for host in hosts
            )
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
        child = subprocess.Popen(
            [*enter, "env", f"--chdir={cwd or self.environment['HOME']}", *command],
            env={**inherited, **self.environment, **(env or {})},
            text=True,
            **{"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
        )
        self._started.append(child)
        return child

    def ssh(self, host: Host | str, command: str, *options: str, timeout: float = TIMEOUT_S) -> Result:
        """Runs a command on a host over ssh, as strictly as a script would."""
        name = host if isinstance(host, str) else host.name
        strict = ("-oBatchMode=yes", "-oStrictHostKeyChecking=yes", "-oConnectTimeout=5")
        return self.run(["ssh", *options, *strict, name, command], timeout=timeout)

    def cut(self) -> None:
        """Takes the operator out of range, as `Host.cut`: the hosts still reach each other."""
        self.space.forward("port0", through=False)

    def restore(self) -> None:
        """Brings it back into range."""
        self.space.forward("port0", through=True)

    def pids(self) -> dict[int, str]:
        """Processes in the operator's network, by pid, with their command lines."""
        return {pid: command_line(pid) for pid in self.space.pids("net") - {self.space.pid}}

    def end(self) -> None:
        """Kills what runs there and lets the network go."""
        for pid in self.pids():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        # A test that failed in the middle left pipes open, which a later one would be blamed for.
        for child in self._started:
            with child:
                child.kill()
        self.space.end()


def _in_home() -> list[str]:
    """Folders of the real home that the tests and the Python under test need, outermost only."""
    home = Path(pwd.getpwuid(os.geteuid()).pw_dir)
    needed = [str(ROOT), tempfile.gettempdir(), sys.prefix, sys.base_prefix, *filter(os.path.isdir, sys.path)]
    inside = {path for path in map(Path, needed) if path.is_relative_to(home) and path != home}
    return sorted(str(path) for path in inside if not inside & set(path.parents))
