"""Which routers of a fleet link to which."""

from __future__ import annotations

import json

import pytest

from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.runtime.router import others
from deploy.console.data_files import FLEETS

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
