"""`status` and `down` where the bus or a host does not answer: the rest is known, and done, all the same."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import pytest
import tomli_w

from agent.fleet.loading import to_dict
from agent.security.certificates import DAY_S
from agent.security.identity import of_operator
from deploy.commands.hosts import down, status
from deploy.console.arguments import no_changes
from deploy.inventory.certificate_builder import CERTIFICATE_DAYS
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
    return argparse.Namespace(**no_changes(), fleet=str(file), hosts=[], json=False)


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

    monkeypatch.setattr("deploy.hosts.jobs.HostConnection", Connection)
    assert down._down(options(secured)) == 0
    assert asked == [("down", {"fleet": "two"})]
    err = capsys.readouterr().err
    assert "not stopped over the bus, robots brake as their processes end: " in err
    assert "left: down, 2 units ended and removed" in err
