"""What `handfast keys` passes between computers, on the command line."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.credentials import authority_of, load
from handfast.agent.security.identity import of_operator
from handfast.deploy.commands.hosts import keys as keys_command
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.operator_credentials import KEYS, OPERATOR, keys_folder, short

Run = Callable[..., str]
FLEET = "delta"
TWO = ("--set", 'network.operators=["main", "anna"]')


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`handfast keys delta ...` of an operator: what it prints. Each has a folder of keys."""
    parser = argparse.ArgumentParser()
    keys_command.add_arguments(parser)

    def keys(who: str, *arguments: str) -> str:
        monkeypatch.setenv(KEYS, str(tmp_path / who))
        monkeypatch.setenv(OPERATOR, who)
        options = parser.parse_args([FLEET, *TWO, *arguments])
        assert options.command(options) == 0
        said = capsys.readouterr()
        assert "PRIVATE" not in said.out + said.err
        return said.out

    return keys


def test_a_second_operator(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("main")
    asked, signed = str(tmp_path / "anna.csr"), str(tmp_path / "anna.crt")
    assert "handfast keys delta --sign anna.csr --out FILE" in run("anna", "--request", "--out", asked)
    rules = authority_of(tmp_path / "main")
    assert short(rules) in run("main", "--sign", asked, "--out", signed)
    assert short(rules) in run("anna", "--install", signed)
    assert keys_folder(FLEET) == tmp_path / "anna", "the environment says where"
    assert load(tmp_path / "anna", of_operator(FLEET, "anna"), time.time()).authority_fingerprint == rules
    assert not (tmp_path / "anna" / "authority.pem").exists()
    assert "operator   anna" in run("main", "--list")
    with pytest.raises(InputError, match=r"of the authority .*, which is not here"):
        run("anna")
    rows = [re.split(" {2,}", row) for row in run("anna", "--list").splitlines()]
    assert [row[:2] + row[3:] for row in rows] == [
        ["authority", short(rules), "on another computer"],
        ["operator", "anna", "valid"],
    ]
    with monkeypatch.context() as later:
        soon, late = (time.time() + days * DAY_S for days in (360, 400))
        later.setattr(keys_command.time, "time", lambda: soon)
        assert re.search(r"expires in [45] days: --request, --sign where", run("anna", "--list"))
        later.setattr(keys_command.time, "time", lambda: late)
        assert "  expired: --request, --sign where" in run("anna", "--list")
    # Another authority: she asks again.
    run("main", "--new-authority")
    run("anna", "--request", "--out", asked)
    run("main", "--sign", asked, "--out", signed)
    run("anna", "--install", signed)
    assert authority_of(tmp_path / "anna") == authority_of(tmp_path / "main") != rules


def test_who_is_no_operator_gets_no_signature(run: Run, tmp_path: Path) -> None:
    run("main")
    run("anna", "--request", "--out", str(tmp_path / "anna.csr"))
    with pytest.raises(InputError, match=r"the request in .*anna.csr is one for the operator anna;"):
        run("main", "--set", 'network.operators=["main"]', "--sign", str(tmp_path / "anna.csr"))


def test_a_request_needs_an_authority_and_a_file(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read /nowhere: no such file or directory"):
        run("main", "--sign", "/nowhere")
    run("anna", "--request", "--out", str(tmp_path / "anna.csr"))
    with pytest.raises(InputError, match=r"delta has no authority in .*: `handfast keys delta` makes it"):
        run("main", "--sign", str(tmp_path / "anna.csr"))
    assert not (tmp_path / "main").exists()


def test_what_is_too_large_is_not_read(run: Run, tmp_path: Path) -> None:
    with open(tmp_path / "large", "wb") as stream:
        stream.truncate(1_000_000)
    run("main")
    for option, why in (
        ("--install", "these are not two certificates"),
        ("--sign", "the request in .*large is too large"),
    ):
        with pytest.raises(InputError, match=why):
            run("main", option, str(tmp_path / "large"))
