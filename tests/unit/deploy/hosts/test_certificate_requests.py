"""`handfast keys --sign`: what robots asked for, signed for a program that carries it."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from agent.fleet.fleet import to_dict
from agent.security.credentials import load, make_request, store
from agent.security.identity import of_robot
from deploy.commands import keys as keys_command
from deploy.console.arguments import InputError
from deploy.inventory.certificate_authority import keys_folder
from tests.unit.deploy.hosts.test_ansible import fleet

Sign = Callable[..., dict[str, Any]]


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """`handfast keys FLEET ...`: what it prints."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    file = tmp_path / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet())))
    parser = argparse.ArgumentParser()
    keys_command.add_parser(parser.add_subparsers())

    def keys(*arguments: str) -> str:
        options = parser.parse_args(["keys", str(file), *arguments])
        assert options.command(options) == 0
        return capsys.readouterr().out

    return keys


@pytest.fixture
def sign(run: Callable[..., str], tmp_path: Path) -> Sign:
    """Signs requests, given as JSON or as they are."""

    def signs(requests: Any, *arguments: str) -> dict[str, Any]:
        file = tmp_path / "requests.json"
        file.write_text(requests if isinstance(requests, str) else json.dumps(requests))
        told: dict[str, Any] = json.loads(run("--sign", str(file), *arguments))
        return told

    return signs


def test_a_robot_takes_what_the_authority_answers(run: Callable[..., str], sign: Sign, tmp_path: Path):
    run()
    assert sign({}) == {"authority": (keys_folder("delta") / "ca.crt").read_text(), "signed": {}}
    asked = {
        str(robot): make_request(tmp_path / str(robot), of_robot("delta", robot)).decode() for robot in (1, 2)
    }
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
    asked = make_request(tmp_path / "1", of_robot("delta", 1)).decode()
    with pytest.raises(InputError, match=r"the request of robot 2 is one for 'delta.robot.1'"):
        sign({"2": asked})


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
        ("no json", "must be JSON, a certificate request .PEM. by robot"),
        ([], "must be JSON"),
        ({"1": 2}, "must be JSON"),
        ({"9": "x"}, "there is no robot 9 in delta"),
        ({"01": "x"}, "there is no robot 01 in delta"),
        ({"1": "x"}, "what came for robot 1 is not a certificate request"),
        ({"1": "\ud800"}, "must be JSON"),
    ],
)
def test_bad_requests(run: Callable[..., str], sign: Sign, requests: Any, what: str):
    run()
    with pytest.raises(InputError, match=what):
        sign(requests)


def test_it_makes_nothing_and_does_nothing_else(sign: Sign):
    with pytest.raises(InputError, match=r"delta has no authority in .*: `handfast keys .*` makes it"):
        sign({})
    assert not keys_folder("delta").exists()
    for option in (["--list"], ["--renew"], ["--replace-authority"]):
        with pytest.raises(InputError, match="--sign only signs"):
            sign({}, *option)
    with pytest.raises(InputError, match="--sign has robots in its file"):
        sign({}, "--robot", "1", "--out", "x")


def test_a_file_that_cannot_be_read(run: Callable[..., str]):
    run()
    with pytest.raises(InputError, match="cannot read /nowhere: no such file or directory"):
        run("--sign", "/nowhere")
