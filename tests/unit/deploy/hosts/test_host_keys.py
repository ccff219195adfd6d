"""Certificates for robots of a host, with what runs there in this process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agent.fleet.fleet import Fleet
from agent.fleet.host_sections import HostSection
from agent.security import __main__
from agent.security.credentials import load
from agent.security.identity import of_robot
from deploy.hosts.host_keys import HostKeys
from deploy.inventory.certificate_authority import Authority
from tests.unit.agent.security.test_credentials import Standard
from tests.unit.deploy.hosts.test_ansible import fleet


class There:
    """A host as `handfast up` talks to it."""

    def __init__(
        self, host: HostSection, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.host, self._patch, self._capsys = host, monkeypatch, capsys
        self.asked: list[str] = []

    def ask(self, what: str, *, module: str, arguments: list[str], version: str, text: str) -> Any:
        assert (what, module, version) == ("run", "agent.security.credentials", "1-aa")
        self.asked.append(arguments[0])
        self._patch.setattr("sys.stdin", Standard(text.encode()))
        assert __main__.main(arguments) == 0
        return self._capsys.readouterr().out


def located() -> Fleet:
    """Six robots on two hosts, as ssh's configuration knows where they are."""
    there = fleet({"rover1": {"address": "10.0.0.1"}, "rover2": {"address": "10.0.0.2"}})
    named = replace(there.hosts[0], address="rover1.lan")
    return replace(there, hosts=(named, *there.hosts[1:]))


@pytest.fixture
def keys(tmp_path: Path) -> Iterator[HostKeys]:
    whole = located()
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time()) as authority:
        yield HostKeys(whole, authority)


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> There:
    """A host whose address the fleet file leaves out: ssh reaches it by its name."""
    return There(HostSection("rover1"), monkeypatch, capsys)


def test_certificates_hold_for_the_address_that_others_dial(
    keys: HostKeys, there: There, tmp_path: Path
) -> None:
    keys(there, "1-aa", str(tmp_path / "keys"))  # type: ignore[arg-type]
    assert there.asked == ["request", "store", "store", "store"], "all robots are asked about at once"
    for robot in (1, 3, 5):
        found = load(tmp_path / "keys", of_robot("delta", robot), time.time())
        assert "rover1.lan" in found.certificate.addresses
        assert "rover1" not in found.certificate.addresses


def test_only_robots_that_need_one_get_one(keys: HostKeys, there: There, tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    keys(there, "1-aa", str(folder))  # type: ignore[arg-type]
    before = {path.name: path.read_bytes() for path in folder.glob("*.crt")}
    (folder / "delta.robot.3.crt").unlink()
    there.asked.clear()
    keys(there, "1-aa", str(folder))  # type: ignore[arg-type]
    assert there.asked == ["request", "store"]
    after = {path.name: path.read_bytes() for path in folder.glob("*.crt")}
    assert [name for name in before if after[name] != before[name]] == ["delta.robot.3.crt"]
    keys(there, "1-aa", str(folder))  # type: ignore[arg-type]
    assert there.asked == ["request", "store", "request"]
