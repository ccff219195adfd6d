"""Certificates for robots on hosts: brought by `handfast up`, or signed for a program that carries them."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from agent.fleet.hosts import HostSection
from agent.fleet.loading import to_dict
from agent.fleet.model import Fleet
from agent.security import __main__
from agent.security.credentials import authority_of, load, make_request, store
from agent.security.identity import of_robot
from deploy.commands.hosts import keys as keys_command
from deploy.console.arguments import InputError
from deploy.hosts.certificates import AnotherAuthorityError, HostKeys
from deploy.hosts.connection import HostError
from deploy.inventory.certificate_authority import Authority
from deploy.inventory.operator_credentials import keys_folder
from tests.trusted import credentials
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
        assert (what, module, version) == ("run", "agent.security", "1-aa")
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


def looked(keys: HostKeys, robots: Path, host: HostSection) -> None:
    """Has `keys` look at a host whose robots' keys are in a folder."""

    class Looked:
        def __init__(self) -> None:
            self.host = host

        def ask(self, what: str, *, folder: str, pattern: str, most: int) -> dict[str, tuple[int, float]]:
            assert (what, folder) == ("listing", "fleets/delta/keys")
            return {path.name: (1, 1.0) for path in robots.glob(pattern)}

        def exchange(
            self, what: str, blob: None, *, data_bytes: int, path: str, most: int
        ) -> tuple[None, bytes]:
            assert (what, path) == ("get", "fleets/delta/keys/ca.crt")
            return None, (robots / "ca.crt").read_bytes()[:most]

    keys.look(Looked())  # type: ignore[arg-type]


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
        "for a certificate of theirs (`handfast keys f.toml --request`), or, where theirs is lost for good, "
        "replace it (`handfast up f.toml --take-over`)"
    )


def test_they_are_taken_over_where_that_is_asked(there: There, tmp_path: Path) -> None:
    robots, whole = tmp_path / "keys", located()
    other_authority(tmp_path, robots)
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time()) as by:
        assert HostKeys(whole, by, by.certificate_pem, "f.toml").is_first
        keys = HostKeys(whole, by, by.certificate_pem, "f.toml", take_over=True)
        looked(keys, robots, there.host)
        assert keys.replaces("rover1")
        assert not keys.is_first
        keys(there, "1-aa", str(robots))  # type: ignore[arg-type]
        looked(keys, robots, there.host)
        assert not keys.replaces("rover1")
        assert {load(robots, of_robot("delta", n), time.time()).authority_fingerprint for n in (1, 3, 5)} == {
            by.fingerprint
        }


def test_those_of_an_authority_that_this_one_has_replaced_get_new_ones(there: There, tmp_path: Path) -> None:
    robots, whole = tmp_path / "keys", located()
    with Authority(tmp_path / "authority", whole.fleet.name, whole.ids, time.time()) as by:
        HostKeys(whole, by, by.certificate_pem, "f.toml")(there, "1-aa", str(robots))  # type: ignore[arg-type]
        by.replace(time.time())
        by.replace(time.time())
        keys = HostKeys(whole, by, by.certificate_pem, "f.toml")
        looked(keys, robots, there.host)
        assert keys.replaces("rover1")
        keys(there, "1-aa", str(robots))  # type: ignore[arg-type]
        assert load(robots, of_robot("delta", 1), time.time()).authority_fingerprint == by.fingerprint


def test_hosts_without_an_authority_or_with_a_damaged_one_are_fine(
    keys: HostKeys, there: There, tmp_path: Path
) -> None:
    robots = tmp_path / "none"
    looked(keys, robots, there.host)
    assert keys.is_first
    robots.mkdir()
    (robots / "ca.crt").write_text("half")
    looked(keys, robots, there.host)
    assert not keys.replaces("rover1")


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
        by.replace(time.time())
        keys = HostKeys(whole, by, by.certificate_pem, "f.toml")
        keys(there, "1-aa", str(robots))  # type: ignore[arg-type]
    with pytest.raises(AnotherAuthorityError, match="left as it was: its robots have another authority"):
        looked(annas, robots, there.host)


Sign = Callable[..., dict[str, Any]]


def asks(folder: Path, robot: int) -> dict[str, str]:
    """As a robot without any certificate asks for its first."""
    return {"request": make_request(folder, of_robot("delta", robot)).decode(), "authority": ""}


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """`handfast keys FLEET ...`: what it prints."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    file = tmp_path / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet())))
    parser = argparse.ArgumentParser()
    keys_command.add_arguments(parser)

    def keys(*arguments: str, status: int = 0) -> str:
        options = parser.parse_args([str(file), *arguments])
        assert options.command(options) == status
        return capsys.readouterr().out

    return keys


@pytest.fixture
def sign(run: Callable[..., str], tmp_path: Path) -> Sign:
    """Signs requests, given as JSON or as they are."""

    def signs(requests: Any, *arguments: str, status: int = 0) -> dict[str, Any]:
        file = tmp_path / "requests.json"
        file.write_text(requests if isinstance(requests, str) else json.dumps(requests))
        told: dict[str, Any] = json.loads(run("--sign", str(file), *arguments, status=status))
        return told

    return signs


def test_a_robot_takes_what_the_authority_answers(run: Callable[..., str], sign: Sign, tmp_path: Path):
    run()
    rules = (keys_folder("delta") / "ca.crt").read_text()
    assert sign({}) == {"authority": rules, "signed": {}, "refused": {}}
    asked = {str(robot): asks(tmp_path / str(robot), robot) for robot in (1, 2)}
    told = sign(asked)
    assert set(told["signed"]) == {"1", "2"}
    for robot, address in ((1, "10.0.0.1"), (2, "10.0.0.2")):
        store(
            tmp_path / str(robot), of_robot("delta", robot), told["signed"][str(robot)].encode(), time.time()
        )
        found = load(tmp_path / str(robot), of_robot("delta", robot), time.time()).certificate
        assert address in found.addresses
    assert [line.split()[:2] for line in run("--list").splitlines()][2:] == [["robot", "1"], ["robot", "2"]]


def test_one_robot_does_not_get_anothers_certificate(run: Callable[..., str], sign: Sign, tmp_path: Path):
    run()
    told = sign({"2": asks(tmp_path / "1", 1)}, status=1)
    assert told["signed"] == {}
    assert "the request of robot 2 is one for 'delta.robot.1'" in told["refused"]["2"]


def test_a_robot_that_is_refused_takes_nothing_from_the_others(
    run: Callable[..., str], sign: Sign, tmp_path: Path
):
    """Requests of a whole batch of hosts are signed together: one that lies must not keep the others."""
    run()
    asked: dict[str, Any] = {str(robot): asks(tmp_path / str(robot), robot) for robot in (1, 2, 3)}
    asked["1"]["authority"] = "ab" * 32
    asked["3"] = {"request": "x" * 9000, "authority": ""}
    asked["4"] = ["nonsense"]
    told = sign(asked, status=1)
    assert set(told["signed"]) == {"2"}
    assert set(told["refused"]) == {"1", "3", "4"}
    assert "its robots have another authority" in told["refused"]["1"]
    assert "robot 4 must be JSON" in told["refused"]["4"]


def test_robots_of_another_authority_get_no_signature_unless_they_are_taken_over(
    run: Callable[..., str], sign: Sign, tmp_path: Path
):
    """The same for whoever carries requests, such as Ansible."""
    run()
    asked = asks(tmp_path / "1", 1) | {"authority": "ab" * 32}
    told = sign({"1": asked}, status=1)
    assert "left as it was: its robots have another authority, abababab" in told["refused"]["1"]
    assert "1" in sign({"1": asked}, "--take-over")["signed"]
    assert "1" in sign({"1": asked | {"authority": authority_of(keys_folder("delta"))}})["signed"]


def test_requests_come_from_standard_input_too(
    run: Callable[..., str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    run()
    file = tmp_path / "empty.json"
    file.write_text("{}")
    with open(file) as stream, monkeypatch.context() as patch:
        patch.setattr("sys.stdin", stream)
        assert json.loads(run("--sign", "-"))["signed"] == {}


@pytest.mark.parametrize(
    ("requests", "what"),
    [
        ("no json", "neither an operator.* nor robots', which must be JSON, by robot what"),
        ([], "must be JSON"),
        ({"9": {"request": "x", "authority": ""}}, "there is no robot 9 in delta"),
        ({"01": {"request": "x", "authority": ""}}, "there is no robot 01 in delta"),
    ],
)
def test_bad_requests(run: Callable[..., str], sign: Sign, requests: Any, what: str):
    run()
    with pytest.raises(InputError, match=what):
        sign(requests)


@pytest.mark.parametrize(
    ("request_of_1", "what"),
    [
        (2, "robot 1 must be JSON"),
        ("-----BEGIN CERTIFICATE REQUEST-----", "robot 1 must be JSON"),
        ({"request": "x"}, "robot 1 must be JSON"),
        ({"request": "x", "authority": None}, "robot 1 must be JSON"),
        ({"request": "\ud800", "authority": ""}, "robot 1 must be JSON"),
        ({"request": "x", "authority": ""}, "the request of robot 1 is not a certificate request"),
    ],
)
def test_a_bad_request(run: Callable[..., str], sign: Sign, request_of_1: Any, what: str):
    run()
    told = sign({"1": request_of_1}, status=1)
    assert what in told["refused"]["1"]
    assert told["signed"] == {}


def test_it_makes_nothing_and_does_nothing_else(sign: Sign):
    with pytest.raises(InputError, match=r"delta has no authority in .*: `handfast keys .*` makes it"):
        sign({})
    assert not keys_folder("delta").exists()
    for option in (["--renew"], ["--replace-authority"], ["--robot", "1", "--out", "x"]):
        with pytest.raises(InputError, match=f"--sign goes alone: leave out {option[0]}"):
            sign({}, *option)


def test_a_file_that_cannot_be_read(run: Callable[..., str]):
    run()
    with pytest.raises(InputError, match="cannot read /nowhere: no such file or directory"):
        run("--sign", "/nowhere")
