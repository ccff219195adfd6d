"""`status` and `down` where the bus or a host does not answer: the rest is known, and done, all the same."""

from __future__ import annotations

import argparse
import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_operator
from handfast.deploy.cli import main
from handfast.deploy.commands.hosts import down, status
from handfast.deploy.console.arguments import no_changes
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import registry
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from handfast.deploy.inventory.registry import Registration
from handfast.deploy.processes.running import PAUSED, RUNS, ProcessState
from tests.trusted import authority, credentials
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, fleet


@pytest.fixture
def secured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fleet whose operator has no certificate here; its file. Its host is what the ssh beside it says."""
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("HANDFAST_KEYS", str(tmp_path / "none"))
    monkeypatch.setattr(status, "LISTEN_S", 0.0)
    file = tmp_path / "two.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet(HOSTS, LEFT, LEFT))))
    return file


def ssh(secured: Path, does: str) -> None:
    script = secured.parent / "ssh"
    script.write_text(f"#!/bin/sh\n{does}\n")
    script.chmod(0o755)


def options(file: Path) -> argparse.Namespace:
    return argparse.Namespace(**no_changes(), fleet=str(file), hosts=[], json=False, each=False)


def test_hosts_are_asked_though_the_bus_cannot_be_opened(
    secured: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ssh(secured, "echo 'ssh: connect to host a port 22: Connection refused' >&2; exit 255")
    assert status._status(options(secured)) == 1
    out, err = capsys.readouterr()
    assert "left: it is there, but no ssh server answers on that port" in out
    assert err.startswith("handfast: agents are not heard, only hosts are asked: ")


def test_a_slow_host_is_not_told_as_interrupted(
    secured: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(status, "HOSTS_TIMEOUT_S", 0.0)
    ssh(secured, "exec sleep 60")
    assert status._status(options(secured)) == 1
    assert "left: it has not said all within 0 s" in capsys.readouterr().out


def test_the_operators_own_certificate_is_told_too(secured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, made_s = secured.parent / "none", time.time() - (CERTIFICATE_DAYS - 12.5) * DAY_S
    with authority(folder, made_s, "two") as by:
        credentials(by, folder, of_operator("two"), now_s=made_s)
    ssh(secured, "exit 255")
    assert status._status(options(secured)) == 1
    out = capsys.readouterr().out
    assert "certificates hold for: operator main 12 days, the authority 3" in out
    assert f"operator main expires in 12 days: `handfast keys {secured}` renews it" in out


def test_down_goes_on_over_ssh_where_it_may_not_stop(
    secured: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    class Connection:
        def __init__(self, *_: object, **__: object) -> None: ...

        def __enter__(self) -> None: ...

        def __exit__(self, *_: object) -> None: ...

        def abort(self) -> None: ...

        def ask(self, what: str, **about: str) -> dict[str, list[str]]:
            asked.append((what, about))
            return {"stopped": ["a", "b"], "left": []}

    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", Connection)
    assert down._down(options(secured)) == 0
    assert asked == [("down", {"fleet": "two"})]
    err = capsys.readouterr().err
    assert "not stopped over the bus, robots brake as their processes end: " in err
    assert "left: down, 2 units ended and removed" in err


# --- a run on this machine ------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that lives, with processes that only seem to; nobody is heard on its bus."""
    (tmp_path / "private").mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: tmp_path / "private")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(status, "LISTEN_S", 0.0)
    folder = tmp_path / "run"
    (folder / "logs").mkdir(parents=True)
    text = (FLEETS / "pair.toml").read_text().replace('"pair"', '"pair-here"')
    (folder / "fleet.toml").write_text(text)
    (folder / "logs" / "robot-2-plant.log").write_text("robot 2 plant: braking\n")
    table = {
        (1, "agent"): ProcessState(7, RUNS, 20.0, 1.0, 50_000_000),
        (1, "plant"): ProcessState(8, PAUSED, 20.0, 1.0, 50_000_000),
        (2, "agent"): ProcessState(9, RUNS, 20.0, 1.0, 50_000_000),
    }
    monkeypatch.setattr("handfast.deploy.hosts.status.fleet_processes", lambda fleet, file: table)
    return folder


def of_run(folder: Path) -> Registration:
    return Registration("pair-here", folder, folder / "fleet.toml")


def rows(text: str) -> dict[tuple[int, str], dict[str, Any]]:
    return {(row["robot"], row["role"]): row for row in json.loads(text)["processes"]}


def test_of_a_run_the_table_of_processes_tells(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with of_run(run):
        assert main(["status", "pair-here", "--json"]) == 1
        text = capsys.readouterr().out
        found = rows(text)
        assert [each["folder"] for each in json.loads(text)["runs"]] == [str(run)]
        assert {process: row["unit"] for process, row in found.items()} == {
            (1, "agent"): "active",
            (1, "plant"): "paused",
            (2, "agent"): "active",
            (2, "plant"): "none",
        }
        assert found[2, "plant"]["says"] == "braking"
        assert main(["status", str(run)]) == 1
        out = capsys.readouterr().out
    assert re.search(r"(?m)^ +2  here  plant    none .* braking$", out), out
    assert re.search(rf"(?m)^run by process \d+ since \S+: {run}$", out), out


def test_a_fleet_that_runs_here_has_no_hosts(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with of_run(run):
        assert main(["status", "pair-here", "--host", "left"]) == 2
    assert capsys.readouterr().err == (
        "handfast: --host: pair-here runs on this machine, and has no hosts: leave it out\n"
    )


def test_where_nothing_is_there_it_says_so(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("handfast.deploy.hosts.status.fleet_processes", lambda fleet, file: {})
    assert main(["status", str(run / "fleet.toml")]) == 1
    assert capsys.readouterr().err.startswith("handfast: fleet pair-here does not answer: none of its 4 ")
    assert main(["status", "pair-here"]) == 2
    assert capsys.readouterr().err.startswith('handfast: no fleet of the name "pair-here" runs here; ')
