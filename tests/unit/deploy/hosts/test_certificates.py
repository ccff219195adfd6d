"""Certificates that `handfast up` brings to robots on hosts."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.security import __main__
from handfast.agent.security.credentials import authority_of, load
from handfast.agent.security.identity import of_robot
from handfast.deploy.hosts.certificates import AnotherAuthorityError, HostKeys
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.inventory.certificate_authority import Authority
from tests.trusted import credentials
from tests.unit.agent.security.test_credentials import Standard
from tests.unit.deploy.hosts.two_hosts import fleet


class There:
    """A host as `handfast up` talks to it."""

    def __init__(
        self, host: HostSection, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.host, self._patch, self._capsys = host, monkeypatch, capsys
        self.asked: list[str] = []

    def ask(self, what: str, *, module: str, arguments: list[str], version: str, text: str) -> Any:
        assert (what, module, version) == ("run", "handfast.agent.security", "1-aa")
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
        yield HostKeys(whole, authority, authority.certificate_pem, "f.toml")


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


def other_authority(tmp_path: Path, robots: Path) -> str:
    """Robots 1, 3 and 5 have certificates of somebody else's authority; its fingerprint."""
    whole = located()
    with Authority(tmp_path / "other", whole.fleet.name, whole.ids, time.time()) as other:
        for robot in (1, 3, 5):
            credentials(other, robots, of_robot("delta", robot), now_s=time.time())
        return other.fingerprint


def looked(keys: HostKeys, robots: Path, host: HostSection, *, runs: bool = True) -> str:
    """Has `keys` look at a host whose robots' keys are in a folder, and of which one runs or not."""

    class Looked:
        def __init__(self) -> None:
            self.host = host

        def ask(self, what: str, **asked: Any) -> Any:
            if what == "status":
                return {"units": {"a": {"ActiveState": "active" if runs else "failed"}}}
            assert (what, asked["folder"]) == ("listing", "fleets/delta/keys")
            return {path.name: (1, 1.0) for path in robots.glob(asked["pattern"])}

        def exchange(
            self, what: str, blob: None, *, data_bytes: int, path: str, most: int
        ) -> tuple[None, bytes]:
            assert (what, path) == ("get", "fleets/delta/keys/ca.crt")
            return None, (robots / "ca.crt").read_bytes()[:most]

    return keys.look(Looked())  # type: ignore[arg-type]


def test_robots_of_another_authority_are_refused_and_what_to_do_is_said(
    keys: HostKeys, there: There, tmp_path: Path
) -> None:
    robots = tmp_path / "keys"
    other = other_authority(tmp_path, robots)
    with pytest.raises(AnotherAuthorityError) as caught:
        looked(keys, robots, there.host)
    own = authority_of(tmp_path / "authority")
    assert str(caught.value) == (
        f"left as it was: its robots have another authority, {other[:16]}; this machine's is {own[:16]}. Ask "
        "for a certificate of theirs (`handfast keys f.toml --request`), or, where theirs was replaced or is "
        "lost, `handfast down f.toml` first"
    )


def test_where_nothing_of_the_fleet_runs_they_get_certificates_of_this_one(
    there: There, tmp_path: Path
) -> None:
    robots, whole = tmp_path / "keys", located()
    other = other_authority(tmp_path, robots)
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time()) as by:
        keys = HostKeys(whole, by, by.certificate_pem, "f.toml")
        assert keys.is_first
        assert looked(keys, robots, there.host, runs=False) == other
        keys(there, "1-aa", str(robots))  # type: ignore[arg-type]
        assert not keys.is_first
        assert looked(keys, robots, there.host) == ""
        assert {load(robots, of_robot("delta", n), time.time()).authority_fingerprint for n in (1, 3, 5)} == {
            by.fingerprint
        }


def test_hosts_without_an_authority_or_with_a_damaged_one_are_fine(
    keys: HostKeys, there: There, tmp_path: Path
) -> None:
    robots = tmp_path / "none"
    looked(keys, robots, there.host)
    assert keys.is_first
    robots.mkdir()
    (robots / "ca.crt").write_text("half")
    assert looked(keys, robots, there.host) == ""


def test_an_operator_without_the_authority_leaves_robots_be_that_need_nothing(
    there: There, tmp_path: Path
) -> None:
    robots, whole = tmp_path / "keys", located()
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time()) as by:
        HostKeys(whole, by, by.certificate_pem, "f.toml")(there, "1-aa", str(robots))  # type: ignore[arg-type]
        annas = HostKeys(whole, None, by.certificate_pem, "f.toml")
        there.asked.clear()
        looked(annas, robots, there.host)
        annas(there, "1-aa", str(robots))  # type: ignore[arg-type]
        assert there.asked == ["request"]
        (robots / "delta.robot.3.crt").unlink()
        with pytest.raises(HostError, match=r"robot 3 needs a certificate \(it has none yet\), and the auth"):
            annas(there, "1-aa", str(robots))  # type: ignore[arg-type]
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time(), new=True) as by:
        HostKeys(whole, by, by.certificate_pem, "f.toml")(there, "1-aa", str(robots))  # type: ignore[arg-type]
    with pytest.raises(AnotherAuthorityError, match="left as it was: its robots have another authority"):
        looked(annas, robots, there.host, runs=False)
