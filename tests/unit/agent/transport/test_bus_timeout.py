"""Who gives up an attempt to open a link how soon."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import ExitStack, suppress
from typing import Any

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.transport import bus, sealed_bus
from handfast.agent.transport.bus import LINK_TIMEOUT_S, OPEN_TIMEOUT_MS, Bus, BusError, Router, settings_of
from handfast.agent.transport.sealed_bus import bus_for
from handfast.deploy.console.arguments import fleet_path


def delta(*sets: str) -> Fleet:
    return load_fleet(fleet_path("delta"), sets)


@pytest.mark.patches
@pytest.mark.parametrize(("listen", "wanted"), [(["tcp/127.0.0.1:7600"], 0.25), ([], LINK_TIMEOUT_S)])
def test_robots_have_that_of_their_fleet_and_operators_have_time(
    monkeypatch: pytest.MonkeyPatch, listen: list[str], wanted: float
) -> None:
    given: dict[str, Any] = {}
    monkeypatch.setattr(sealed_bus, "Bus", lambda **settings: given.update(settings))
    bus_for(delta("network.link_timeout_s=0.25"), None, None, print, listen=listen, connect=[])
    assert given["link_timeout_s"] == wanted


def test_zenoh_itself_gives_an_attempt_up_late_but_for_a_client_that_finds_no_router() -> None:
    """Where its own limit runs out between sending and reading, a link stands that nobody reads from."""
    peer, client = (settings_of(mode, [], [], None, 0.25) for mode in ("peer", "client"))
    assert peer["transport/unicast/open_timeout"] == client["transport/unicast/open_timeout"] == 10_000
    assert client["connect/timeout_ms"] == 250


@pytest.mark.patches
def test_a_peer_that_does_not_answer_is_dialled_again() -> None:
    """Else the first packet that gets through to it would be of an attempt seconds later."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(0.02)
        port = silent.getsockname()[1]
        with (
            Bus(listen=[], connect=[f"tcp/127.0.0.1:{port}"], link_timeout_s=0.1) as bus,
            ExitStack() as stack,
        ):
            dialled: list[float] = []
            until = time.monotonic() + 10.0
            while len(dialled) < 2 and time.monotonic() < until:
                with suppress(TimeoutError):
                    stack.enter_context(silent.accept()[0])
                    dialled.append(time.monotonic())
                list(bus.drain())  # as a process does in each of its ticks
    assert dialled[1] - dialled[0] < LINK_TIMEOUT_S


@pytest.mark.patches
def test_the_second_router_is_tried_though_the_first_does_not_answer() -> None:
    """Zenoh itself would try the first again and again."""
    with socket.create_server(("127.0.0.1", 0)) as silent, socket.create_server(("127.0.0.1", 0)) as found:
        first, second = (f"tcp/127.0.0.1:{each.getsockname()[1]}" for each in (silent, found))
        found.close()
        ends: dict[str, Any] = {"listen": [], "connect": [], "routers": [first, second]}
        begun = time.monotonic()
        with Router([second], [], None), Bus(**ends, link_timeout_s=0.2) as bus:
            assert [str(link.dst) for link in bus._far.info.links()] == [second]
            assert time.monotonic() - begun < OPEN_TIMEOUT_MS / 1000, "Zenoh's own limit"


def test_no_router_of_several_is_an_error_at_once() -> None:
    with pytest.raises(BusError, match=r"no router answers at tcp/127\.0\.0\.1:1 or tcp/127\.0\.0\.1:2"):
        Bus(listen=[], connect=[], routers=["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"])
    assert settings_of("client", [], ["tcp/a:1", "tcp/b:1"], None, 0.25)["connect/timeout_ms"] == 0


@pytest.mark.patches
def test_a_session_is_closed_though_a_peer_does_not_answer() -> None:
    """Zenoh waits for what it has begun to open: ten seconds."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        bus = Bus(listen=[], connect=[f"tcp/127.0.0.1:{silent.getsockname()[1]}"])
        with silent.accept()[0]:
            begun = time.monotonic()
            bus.close()
            assert time.monotonic() - begun < LINK_TIMEOUT_S


def test_a_bus_that_is_left_closes_nothing() -> None:
    bus = Bus(listen=[], connect=[])
    [session] = bus._sessions
    bus.leave()
    bus.close()
    assert not session.is_closed()
    session.close()


@pytest.mark.patches
def test_a_link_that_is_opened_anew_is_heard_over_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as found:
        endpoint = f"tcp/127.0.0.1:{found.getsockname()[1]}"
    with Bus(listen=[endpoint], connect=[]) as there, Bus(listen=[], connect=[endpoint]) as here:
        here.subscribe("all/**")
        there.declare("all/told")

        def links() -> set[str]:
            """Of the one that connects, once something has been heard over it."""
            until = time.monotonic() + 10.0
            list(here.drain())
            while time.monotonic() < until:
                there.publish("all/told", b"something")
                if list(here.drain()):
                    return {str(link.src) for link in here._sessions[0].info.links()}
                time.sleep(0.01)
            raise AssertionError("nothing is heard")

        before = links()
        assert not here.reopen("tcp/127.0.0.1:9")
        until = time.monotonic() + 10.0
        while not here.reopen(endpoint) and time.monotonic() < until:  # it is one that the watch knows
            links()
        while (after := links()) == before and time.monotonic() < until:
            pass
        assert len(before) == len(after) == 1
        assert before != after


def test_a_router_that_does_not_answer_is_given_more_time_with_each_try(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[float] = []

    def refuses(
        _mode: str, _listen: object, _routers: object, _security: object, timeout_s: float, **_: object
    ) -> None:
        tried.append(timeout_s)
        raise BusError("no router answers")

    monkeypatch.setattr(bus, "_open", refuses)
    monkeypatch.setattr(bus, "RETRY_MS", (0, 0))
    with pytest.raises(BusError):
        bus._open_client(["tcp/127.0.0.1:9"], None, lambda: len(tried) < 5, 0.4)
    assert tried == pytest.approx([0.4, 0.8, 1.6, 1.6, 1.6])


def test_who_is_not_wanted_any_more_waits_for_no_router() -> None:
    """Zenoh waits for seconds, in which the main thread would answer no signal."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        router = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        asked: list[float] = []

        def is_wanted() -> bool:
            asked.append(time.monotonic())
            return len(asked) < 3

        begun = time.monotonic()
        with pytest.raises(BusError, match="not wanted any more"):
            Bus(listen=[], connect=[], routers=[router], is_wanted=is_wanted)
        assert time.monotonic() - begun < LINK_TIMEOUT_S
        assert bus.is_opening(), "it is left behind"
    for thread in tuple(bus._OPENING):
        thread.join(3 * OPEN_TIMEOUT_MS / 1000)
    assert not bus.is_opening()


@pytest.mark.patches
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_session_that_opens_when_nobody_wants_it_any_more_is_closed(
    monkeypatch: pytest.MonkeyPatch, interrupted: bool
) -> None:
    """As of a `stop` that was known to be obeyed before a router answered, or after Ctrl-C: an interpreter
    hangs on one that is open."""
    closed: list[object] = []
    monkeypatch.setattr(bus, "_close", closed.append)
    goes_on = threading.Event()
    session = object()

    def opens() -> object:
        goes_on.wait(10.0)
        return session

    def is_wanted() -> bool:
        if interrupted:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt if interrupted else BusError):
        bus._while_wanted(opens, is_wanted)
    assert bus.is_opening()
    goes_on.set()
    for thread in tuple(bus._OPENING):
        thread.join(10.0)
    assert closed == [session]
    assert not bus.is_opening()
    assert bus._while_wanted(lambda: session, lambda: True) is session
    assert closed == [session]
