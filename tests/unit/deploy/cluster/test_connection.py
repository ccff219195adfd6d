"""Bounded time to a scheduler, whatever is there."""

from __future__ import annotations

import asyncio
import gc
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress

import pytest
from distributed.security import Security
from distributed.versions import VersionMismatchWarning

from handfast.deploy.cluster import connection
from handfast.deploy.cluster.connection import ClusterError, GivenUp, connected, patiently


async def stubborn() -> None:
    """Ends by no cancelling."""
    until_s = time.monotonic() + 1.0
    while time.monotonic() < until_s:
        try:
            await asyncio.sleep(0.1)
        except asyncio.CancelledError:
            continue


def test_what_takes_too_long_is_left() -> None:
    async def look() -> float:
        begun_s = time.monotonic()
        with pytest.raises(TimeoutError):
            await patiently(stubborn, 0.1, lambda: True)
        return time.monotonic() - begun_s

    assert asyncio.run(look()) < 0.9


def test_what_is_not_wanted_is_left_at_once() -> None:
    with pytest.raises(GivenUp):
        asyncio.run(patiently(stubborn, 9.0, lambda: False))


def test_what_comes_of_it_is_given() -> None:
    async def answer() -> int:
        return 42

    assert asyncio.run(patiently(answer, 9.0, lambda: True)) == 42


@pytest.fixture(params=[b"", b"HTTP/1.0 400 Bad request\r\n\r\n" * 9])
def no_scheduler(request: pytest.FixtureRequest) -> Iterator[str]:
    """A port where somebody listens who says this, or nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            held = []
            with suppress(OSError):
                while True:
                    held.append(server.accept()[0])
                    held[-1].sendall(request.param)
            for each in held:
                each.close()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with suppress(OSError):  # its accept ends
            server.shutdown(socket.SHUT_RDWR)
        thread.join()


def test_a_port_that_is_no_scheduler_is_given_up_and_leaves_nothing(
    no_scheduler: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(connection, "CONNECT_S", 0.2)
    monkeypatch.setattr(connection, "SPARE_S", 0.2)
    begun_s = time.monotonic()
    with (
        pytest.raises(ClusterError, match=rf"^there is no scheduler at {no_scheduler}: [^\n]+$"),
        connected(no_scheduler, Security(), no_scheduler, lambda: True),
    ):
        raise AssertionError
    gc.collect()
    assert time.monotonic() - begun_s < connection.CLOSE_S
    assert "Traceback" not in capfd.readouterr().err


def test_of_versions_dask_shows_no_table_and_of_anything_else_what_it_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def warn(_self: object, timeout: float) -> None:
        warnings.warn(VersionMismatchWarning("a table"), stacklevel=1)
        warnings.warn("something else", stacklevel=1)

    monkeypatch.setattr(connection.Client, "_start", warn)
    with (
        pytest.warns(UserWarning, match="something else") as caught,
        connected("tcp://127.0.0.1:1", Security(), "it", lambda: True),
    ):
        pass
    assert [str(each.message) for each in caught] == ["something else"]


def test_nobody_waits_for_what_nobody_wants(no_scheduler: str) -> None:
    begun_s = time.monotonic()
    with pytest.raises(GivenUp), connected(no_scheduler, Security(), "it", lambda: False):
        raise AssertionError
    assert time.monotonic() - begun_s < connection.CONNECT_S / 2
