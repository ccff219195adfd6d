"""A fleet on test hosts, and the operator's commands for it."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pytest
import tomli_w

from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.hosts.bundle import Platform, bundle_for
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.process.harness import ROOT, wait_for

UP_TIMEOUT_S: Final = 240.0
COMMAND_TIMEOUT_S: Final = 90.0
_ABOUT: Final = (
    "import json, platform, sys; print(json.dumps({'python': list(sys.version_info[:3]), 'machine': "
    "platform.machine(), 'system': platform.system(), 'libc': list(platform.libc_ver())}))"
)


def fetch_wheels(host: Host, cache: Path) -> None:
    """Has the operator's cache hold what that host needs: the operator's network leads nowhere else."""
    told = host.run(["python3", "-c", _ABOUT], check=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        bundle_for(Platform.of(json.loads(told.stdout)), b"")


def delta(hosts: Sequence[Host], **tables: dict[str, Any]) -> dict[str, Any]:
    """The tables of the bundled fleet, its robots on these hosts in turn; `tables` are laid over its own."""
    raw = tomllib.loads((FLEETS / "delta.toml").read_text(encoding="utf-8"))
    raw["host"] = {host.name: {"address": host.address} for host in hosts}
    for index, robot in enumerate(raw["robot"]):
        robot["host"] = hosts[index % len(hosts)].name
    for name, table in tables.items():
        raw[name] = raw.get(name, {}) | table
    return raw


class FleetOnHosts:
    """A fleet file in `folder`, and `handfast` in the operator's network.

    Args:
        cache: the operator's, with wheels in it.
        source: the tree whose `handfast` it is.
    """

    def __init__(
        self, hosts: Hosts, folder: Path, tables: dict[str, Any], cache: Path, source: Path = ROOT
    ) -> None:
        self.hosts, self.folder, self.cache, self.source = hosts, folder, cache, source
        self.file = folder / "fleet.toml"
        self.file.write_text(tomli_w.dumps(tables), encoding="utf-8")
        self.name: str = tables["fleet"]["name"]

    def words(self, command: str, *arguments: str) -> list[str]:
        return [sys.executable, "-P", "-m", "handfast.deploy.cli", command, str(self.file), *arguments]

    def environment(self) -> dict[str, str]:
        return {"PYTHONPATH": str(self.source), "XDG_CACHE_HOME": str(self.cache)}

    def handfast(
        self, command: str, *arguments: str, status: int | None = 0, timeout: float = COMMAND_TIMEOUT_S
    ) -> subprocess.CompletedProcess[str]:
        """Runs a command for this fleet; fails the test when it ends with another status."""
        done = self.hosts.operator.run(
            self.words(command, *arguments), env=self.environment(), cwd=self.folder, timeout=timeout
        )
        said = f"{done.stdout}\n{done.stderr}"
        assert "Traceback" not in said, said
        if status is not None:
            assert done.returncode == status, said
        return done

    def by_name(self, command: str, *arguments: str) -> str:
        """What a command prints that is given no fleet file."""
        done = self.hosts.operator.run(
            [sys.executable, "-P", "-m", "handfast.deploy.cli", command, *arguments],
            # The operator shares this machine's folder for temporary files: others' fleets may run here.
            env=self.environment() | {"TMPDIR": str(self.folder)},
            cwd=self.folder,
            timeout=COMMAND_TIMEOUT_S,
        )
        assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
        return str(done.stdout)

    def listed(self) -> list[dict[str, Any]]:
        """What `handfast status` shows."""
        rows: list[dict[str, Any]] = json.loads(self.by_name("status", "--json"))["fleets"]
        return rows

    def start(self, command: str, *arguments: str) -> subprocess.Popen[str]:
        return self.hosts.operator.popen(
            self.words(command, *arguments), env=self.environment(), cwd=self.folder
        )

    def status(self) -> dict[tuple[int, str], dict[str, Any]]:
        """What `handfast status` knows, by robot and process."""
        told = json.loads(self.handfast("status", "--json", status=None).stdout)
        return {(row["robot"], row["role"]): row for row in told["processes"]}

    def process(self, robot: int, role: str) -> int:
        """The process of a robot, as this machine counts."""
        host = self.host_of(robot)
        module = {
            "agent": "-m handfast.agent ",
            "plant": "-m handfast.plant ",
            "recorder": "-m handfast.agent.recorder ",
        }[role]
        found = [pid for pid, words in host.pids(module).items() if f"--robot {robot} " in f"{words} "]
        assert len(found) == 1, host.pids()
        return found[0]

    def started_again(self, robot: int, role: str, before: int) -> None:
        """Waits until a robot has another process than `before`."""

        def look() -> bool:
            host = self.host_of(robot)
            pids = [
                pid
                for pid, words in host.pids(f"-m handfast.{role} ").items()
                if f"--robot {robot} " in f"{words} "
            ]
            return bool(pids) and before not in pids

        wait_for(look, f"robot {robot}'s {role} starts again", 30.0)

    def host_of(self, robot: int) -> Host:
        tables = tomllib.loads(self.file.read_text(encoding="utf-8"))
        name = next(row["host"] for row in tables["robot"] if row["id"] == robot)
        return next(host for host in self.hosts if host.name == name)

    def processes(self) -> set[int]:
        """All processes of the fleet, on all hosts."""
        return {pid for host in self.hosts for pid in host.pids(f"/fleets/{self.name}/")}
