"""Which routers of a fleet link to which, and which cannot begin."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.common.errors import BAD_INPUT, FAILED
from handfast.agent.fleet.loading import load_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.router import main, others
from handfast.deploy.console.data_files import FLEETS

AWAY = "192.0.2.7:7447"  # RFC 5737: nobody has it
HERE = "127.0.0.1:7447"


def routed(*routers: str) -> Fleet:
    return load_fleet(FLEETS / "pair.toml", [f"network.routers={json.dumps(routers)}"])


def test_of_two_routers_the_later_one_links_to_the_earlier() -> None:
    fleet = routed(AWAY, HERE)
    assert others(fleet, f"tcp/{AWAY}") == []
    assert others(fleet, f"tcp/{HERE}") == [f"tcp/{AWAY}"]


@pytest.mark.parametrize(
    ("listen", "linked"),
    [("tcp/0.0.0.0:7447", [f"tcp/{AWAY}"]), ("tcp/0.0.0.0:7448", [f"tcp/{AWAY}", f"tcp/{HERE}"])],
)
def test_a_router_on_another_address_than_the_file_has_does_not_link_to_itself(
    listen: str, linked: list[str]
) -> None:
    assert others(routed(AWAY, HERE), listen) == linked


def written(tmp_path: Path, fleet: Fleet) -> str:
    file = tmp_path / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet)))
    return str(file)


@pytest.mark.parametrize("number", ["0", "3"])
def test_a_router_that_the_fleet_lacks_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], number: str
) -> None:
    assert main(["--fleet", written(tmp_path, routed(AWAY, HERE)), "--number", number]) == BAD_INPUT
    assert capsys.readouterr().err == f"router {number}: there is no router {number}: the fleet has 2\n"


def test_one_of_a_secured_fleet_needs_its_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secured = load_fleet(FLEETS / "pair.toml", [f'network.routers=["{HERE}"]', 'network.security="mtls"'])
    assert main(["--fleet", written(tmp_path, secured)]) == BAD_INPUT
    assert "this fleet is secured: give the folder of the router's key" in capsys.readouterr().err
    assert main(["--fleet", written(tmp_path, secured), "--keys", str(tmp_path / "keys")]) == BAD_INPUT
    assert "router main of pair has no certificate" in capsys.readouterr().err


def test_one_whose_address_is_another_machines_cannot_begin_now(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--fleet", written(tmp_path, routed(AWAY))]) == FAILED
    assert f"cannot listen on tcp/{AWAY}: this machine does not have that address" in capsys.readouterr().err
