"""`handfast keys` on the command line."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.security.credentials import RENEW_DAYS, authority_of, load
from handfast.agent.security.identity import of_operator, of_robot, of_router
from handfast.deploy.commands.hosts import keys as keys_command
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.certificate_authority import AUTHORITY_DAYS, CERTIFICATE_DAYS
from handfast.deploy.inventory.operator_credentials import keys_folder
from handfast.deploy.inventory.registry import note_down, note_up
from tests.unit.deploy.hosts.two_hosts import fleet

Run = Callable[..., list[str]]
DAY_S = 86_400
FLEET = "delta"
ME = of_operator(FLEET)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`handfast keys delta ...`: the lines that it prints."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    parser = argparse.ArgumentParser()
    keys_command.add_arguments(parser)

    def keys(*arguments: str) -> list[str]:
        options = parser.parse_args([FLEET, *arguments])
        assert options.command(options) == 0
        said = capsys.readouterr()
        assert "PRIVATE" not in said.out + said.err
        return said.out.splitlines()

    return keys


def test_from_nothing_and_again(run: Run) -> None:
    said = run()
    assert said[0].startswith(f"made authority 1 of delta in {keys_folder(FLEET)}")
    assert said[1].endswith("delta.operator.main.crt (it has none yet)")
    assert [line.split()[0] for line in said[2:]] == ["authority", "operator"]
    before = load(keys_folder(FLEET), ME, time.time()).certificate
    assert run() == said[2:]
    assert load(keys_folder(FLEET), ME, time.time()).certificate == before
    assert run("--list") == said[2:]


def test_renewed_in_time(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    begun_s = time.time()
    run()
    before = load(keys_folder(FLEET), ME, begun_s).certificate
    late_s = begun_s + (CERTIFICATE_DAYS - RENEW_DAYS + 1) * DAY_S
    monkeypatch.setattr(time, "time", lambda: late_s)
    assert re.search("expires in 2[89] days: renewed", run("--list")[-1])
    assert re.search(r"\(it expires in 2[89] days\)", run()[0])
    after = load(keys_folder(FLEET), ME, late_s).certificate
    assert after.not_after_s > before.not_after_s
    assert after.public_key != before.public_key
    assert run("--renew")[0].startswith("operator main: made")


def test_a_router_and_a_robot_to_be_carried(run: Run, tmp_path: Path) -> None:
    run("--router", "--address", "10.0.0.9", "--address", "hall.lan", "--out", str(tmp_path / "hall"))
    found = load(tmp_path / "hall", of_router(FLEET), time.time()).certificate
    assert {"10.0.0.9", "hall.lan"} <= set(found.addresses)
    run("--router", "--set", 'network.routers=["10.0.0.7:7447", "[fe80::7]:7447"]')
    found = load(keys_folder(FLEET), of_router(FLEET), time.time()).certificate
    assert {"10.0.0.7", "fe80::7"} <= set(found.addresses)
    said = run("--robot", "3", "--out", str(tmp_path / "r3"), "--set", 'network.address="10.0.0.3"')
    found = load(tmp_path / "r3", of_robot(FLEET, 3), time.time()).certificate
    assert "10.0.0.3" in found.addresses
    names = ["operator main", "robot 3", "router main"]
    assert [" ".join(line.split()[:2]) for line in said[-3:]] == names
    assert not (keys_folder(FLEET) / "delta.robot.3.key").exists()


def test_another_operator(run: Run) -> None:
    run("--operator", "ann", "--set", 'network.operators=["main", "ann"]')
    load(keys_folder(FLEET), of_operator(FLEET, "ann"), time.time())


def test_a_new_authority_revokes_all_certificates(run: Run, tmp_path: Path) -> None:
    run("--robot", "3", "--out", str(tmp_path / "r3"))
    said = run("--new-authority")
    assert said[0].startswith(f"made authority 2 of delta in {keys_folder(FLEET)}")
    assert said[1].startswith("All previous certificates are revoked")
    assert [line.split()[-1] for line in said if line.startswith("operator  ")] == ["valid"]
    assert said[-1].endswith("void: of an authority that was replaced")
    assert run("--robot", "3", "--out", str(tmp_path / "r3"))[-1].endswith("valid")


def test_an_authority_is_not_replaced_while_its_fleet_is_up(run: Run, tmp_path: Path) -> None:
    on_hosts = fleet()
    run()
    note_up(on_hosts, tmp_path / "fleet.toml", ["rover1"], complete=True)
    before = authority_of(keys_folder(FLEET))
    with pytest.raises(InputError, match=r"delta \(up on rover1 since .*`handfast down` first"):
        run("--new-authority")
    assert authority_of(keys_folder(FLEET)) == before
    run("--new-authority", "--force")
    note_down(on_hosts, ["rover1"])
    run("--new-authority")
    assert authority_of(keys_folder(FLEET)) != before


def test_a_router_needs_an_address(run: Run) -> None:
    with pytest.raises(InputError, match="those on hosts get theirs from `handfast up`"):
        run("--router")


def test_an_authority_about_to_end_is_told_of(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    begun_s = time.time()
    run()
    late_s = begun_s + (AUTHORITY_DAYS - 20) * DAY_S
    monkeypatch.setattr(time, "time", lambda: late_s)
    assert re.search(r"ends in (19|20) days, and all certificates with it: --new", run("--list")[0])
    said = run()  # renews it once, to the authority's end, and not again
    assert said[0].startswith("operator main: made")
    assert re.search(r"ends in (19|20) days, with its authority", said[-1])
    assert run() == said[1:]
    monkeypatch.setattr(time, "time", lambda: late_s + 20 * DAY_S)
    assert "expired: --new-authority" in run("--list")[0]
    assert run("--new-authority")[0].startswith("made authority 2 of delta")


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["--list"], "delta has no authority in .*: `handfast keys delta` makes it"),
        (["--list", "--renew"], "--list goes alone: leave out --renew"),
        (["--sign", "x", "--install", "y"], "--sign goes alone: leave out --install"),
        (["--request"], "--request needs --out FILE"),
        (["--force"], "--force belongs to --new-authority"),
        (["--sign", "/nowhere"], "cannot read /nowhere: no such file"),
        (["--install", "/nowhere"], "cannot read /nowhere: no such file"),
        (["--robot", "3"], "--robot and --out DIR belong together"),
        (["--out", "x"], "--robot and --out DIR belong together"),
        (["--robot", "9", "--out", "x"], "no robot 9 in delta"),
        (["--router"], "--router needs --address"),
        (["--address", "a"], "--address is that of a robot or a router"),
        (["--robot", "1", "--router", "--out", "x", "--address", "b"], "not both"),
        (["--operator", "a b"], "operator's name 'a b' must be 1 to 20"),
        (["--operator", "eve"], "robots of delta take no orders of eve: network.operators are main"),
        (["--keys", "/proc/nothing"], "cannot make the folder /proc/nothing"),
    ],
)
def test_bad_input(run: Run, arguments: list[str], what: str) -> None:
    with pytest.raises(InputError, match=what) as raised:
        run(*arguments)
    assert len(str(raised.value).splitlines()) == 1
    assert not keys_folder(FLEET).exists(), "what cannot be done makes nothing"
