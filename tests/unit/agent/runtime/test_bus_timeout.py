"""Who gives up an attempt to open a link how soon."""

from __future__ import annotations

import socket
import time
from typing import Any

import pytest

from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.runtime import sealed_bus
from agent.runtime.bus import LINK_TIMEOUT_S, Bus, settings_of
from agent.runtime.sealed_bus import bus_for
from deploy.console.arguments import fleet_path


def delta(*sets: str) -> Fleet:
    return load_fleet(fleet_path("delta"), sets)


@pytest.mark.parametrize(("listen", "wanted"), [(["tcp/127.0.0.1:7600"], 0.25), ([], LINK_TIMEOUT_S)])
def test_robots_have_that_of_their_fleet_and_operators_have_time(
    monkeypatch: pytest.MonkeyPatch, listen: list[str], wanted: float
) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(sealed_bus, "Bus", lambda **settings: given.update(settings))
    bus_for(delta("network.link_timeout_s=0.25"), None, None, print, listen=listen, connect=[])
    assert given["link_timeout_s"] == wanted


def test_zenoh_is_told_for_links_to_peers_and_to_routers() -> None:
    peer, client = (settings_of(mode, [], [], None, 0.25) for mode in ("peer", "client"))
    assert peer["transport/unicast/open_timeout"] == client["transport/unicast/open_timeout"] == 250
    assert client["connect/timeout_ms"] == 250


def test_a_peer_that_does_not_answer_is_dialled_again() -> None:
    """Else the first packet that gets through to it would be of an attempt seconds later."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(10.0)
        port = silent.getsockname()[1]
        with Bus(listen=[], connect=[f"tcp/127.0.0.1:{port}"], link_timeout_s=0.1):
            first, _ = silent.accept()
            begun = time.monotonic()
            second, _ = silent.accept()
            with first, second:
                assert time.monotonic() - begun < LINK_TIMEOUT_S
