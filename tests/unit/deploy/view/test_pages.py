"""Who shows the token is told all, at its own speed, and can harm neither the fleet nor other pages."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, NamedTuple

import numpy as np
import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from handfast.deploy.playback.scene import COLUMNS
from handfast.deploy.view.live_fleet import FORCE_COLUMNS, HEAD, HISTORY_COLUMNS
from handfast.deploy.view.pages import AHEAD, FULL, PAGES_MAX, REFUSED, Pages
from handfast.deploy.view.server import MESSAGE_BYTES_MAX, TALK_PATH, Content, Server
from tests.unit.deploy.orders.order_fleets import S
from tests.unit.deploy.view.running import FLEET, Running

TOKEN = "the token"
TOO_LONG = 1009
WAIT_S = 20.0
"""What takes longer than that does not come."""


class Noted:
    """`Orders` that keeps what was ordered, and answers questions when it may."""

    def __init__(self) -> None:
        self.taken: list[Mapping[str, Any]] = []
        self.asked: list[Mapping[str, Any]] = []
        self.may_answer = asyncio.Event()
        self.may_answer.set()

    def take(self, content: Mapping[str, Any]) -> None:
        self.taken.append(content)

    async def preview(self, content: Mapping[str, Any]) -> dict[str, Any]:
        self.asked.append(content)
        await self.may_answer.wait()
        return {"number": content.get("number")}


class Turn(NamedTuple):
    """What a page gets at once: what is new, the past, and the newest frame."""

    told: dict[str, Any]
    past: bytes | None
    frame: bytes

    @property
    def number(self) -> int:
        return int(HEAD.unpack_from(self.frame)[2])

    @property
    def columns(self) -> int:
        return int(HEAD.unpack_from(self.frame)[3])


class Page:
    """A page as a browser has it."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.drawn = 0

    async def say(self, content: object) -> None:
        await self.connection.send(content if isinstance(content, str | bytes) else json.dumps(content))

    async def turn(self, *, draws: bool = True) -> Turn:
        """The next turn, which it draws, or not."""
        told: dict[str, Any] = {}
        past = None
        while True:
            said = await asyncio.wait_for(self.connection.recv(), WAIT_S)
            if isinstance(said, str):
                assert not told  # once in a turn
                told = json.loads(said)
            elif HEAD.unpack_from(said)[3] == HISTORY_COLUMNS:
                past = said
            else:
                break
        self.drawn += draws
        if draws:
            await self.say(self.drawn)
        return Turn(told, past, said)

    async def closed(self) -> tuple[int, list[str | bytes]]:
        """With what code the connection ends, and what came before."""
        came: list[str | bytes] = []
        with suppress(ConnectionClosed):
            while True:
                came.append(await asyncio.wait_for(self.connection.recv(), WAIT_S))
        await self.connection.wait_closed()
        assert self.connection.close_code is not None
        return self.connection.close_code, came


class Served:
    """A fleet whose frames the test makes, and the server of its pages."""

    def __init__(self, running: Running, orders: Noted | None) -> None:
        self.running, self.live = running, running.live
        self.pages = Pages(running.live, TOKEN, orders)
        self.server = Server(answer, "default-src 'none'", talk=self.pages.talk)
        self.port = int(self.server.address.rstrip("/").rpartition(":")[2])

    async def frame(self) -> int:
        """The next frame: its number."""
        self.running.clock.ns += S // 20
        self.pages.step()
        for _ in range(5):
            await asyncio.sleep(0)
        return self.live.number

    @asynccontextmanager
    async def connected(self) -> AsyncIterator[Page]:
        origin: Any = self.server.address.rstrip("/")
        where = f"ws://127.0.0.1:{self.port}/{TALK_PATH}"
        async with connect(where, origin=origin, compression=None, max_size=None) as connection:
            yield Page(connection)

    @asynccontextmanager
    async def opened(self) -> AsyncIterator[Page]:
        """A page that has shown the token, and is known."""
        before = len(self.pages)
        async with self.connected() as page:
            await page.say({"token": TOKEN})
            await until(lambda: len(self.pages) == before + 1)
            yield page


def answer(path: str) -> Content | None:
    return Content(b"page", "text/html") if path == "" else None


async def until(look: Callable[[], bool]) -> None:
    """Lets others work until it is so."""

    async def wait() -> None:
        while not look():
            await asyncio.sleep(0.001)

    await asyncio.wait_for(wait(), WAIT_S)


def run(test: Callable[[Served], Awaitable[None]], orders: Callable[[], Noted] | None = Noted) -> None:
    """Runs a test with a server of its own."""

    async def main() -> None:
        with Running() as running:
            served = Served(running, None if orders is None else orders())
            task = asyncio.create_task(served.server.serve())
            try:
                await test(served)
            finally:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
                served.server.close()

    asyncio.run(main())


def noted(served: Served) -> Noted:
    orders = served.pages._orders
    assert isinstance(orders, Noted)
    return orders


# ---------------------------------------------------------------------- who is told anything


@pytest.mark.parametrize(
    "first",
    [
        '{"token": "another"}',
        '{"token": ""}',
        '{"token": "the token "}',
        '{"token": null}',
        '{"token": ["the token"]}',
        '{"token": "\\ud800"}',
        '{"order": {"id": "1", "kind": "stop"}}',
        '"the token"',
        "the token",
        "1",
        "[]",
        "",
        "[" * 10_000,
        b'{"token": "the token"}',
        b"\xff",
    ],
)
def test_who_does_not_show_the_token_first_is_told_nothing(first: str | bytes) -> None:
    async def test(served: Served) -> None:
        async with served.connected() as page:
            await served.frame()
            await page.say(first)
            assert await page.closed() == (REFUSED, [])
        assert noted(served).taken == []

    run(test)


def test_one_page_too_many_is_refused() -> None:
    async def test(served: Served) -> None:
        async with asyncio.TaskGroup() as group:
            release = asyncio.Event()

            async def hold() -> None:
                async with served.connected() as page:
                    await page.say({"token": TOKEN})
                    await release.wait()

            for _ in range(PAGES_MAX):
                group.create_task(hold())
            await until(lambda: len(served.pages) == PAGES_MAX)
            async with served.connected() as page:
                await page.say({"token": TOKEN})
                assert await page.closed() == (FULL, [])
            assert len(served.pages) == PAGES_MAX
            release.set()
        await until(lambda: not len(served.pages))
        async with served.opened() as page:
            await served.frame()
            assert (await page.turn()).number == served.live.number

    run(test)


# ---------------------------------------------------------------------- what a page gets


def test_a_page_gets_all_there_is_and_then_what_changes() -> None:
    async def test(served: Served) -> None:
        live = served.live
        live.put("one", 1)
        live.put("two", {"a": [1.5]})
        live.logs["events"] += ["first", "second"]
        async with served.opened() as page:
            await served.frame()
            turn = await page.turn()
            assert turn.told["drive"] == 0
            assert set(turn.told["parts"]) == set(live.parts) >= {"scene", "panel", "links", "one", "two"}
            assert turn.told["parts"]["two"] == {"a": [1.5]}
            assert turn.told["logs"]["events"] == ["first", "second"]
            assert (turn.number, turn.past) == (1, None)

            await served.frame()
            assert await page.turn() == Turn({}, None, live.frame(forces=False))

            live.put("two", {"a": [1.5]})
            live.put("one", 2)
            live.put("one", 3)
            live.logs["events"].append("third")
            await served.frame()
            assert (await page.turn()).told == {"parts": {"one": 3}, "logs": {"events": ["third"]}}
            await served.frame()
            assert (await page.turn()).told == {}

    run(test)


def past_rows(turn: Turn) -> list[float]:
    """The times of the rows of the past, s."""
    assert turn.past is not None
    width = len(FLEET.ids) * (len(COLUMNS) - FORCE_COLUMNS) + 1
    times = np.frombuffer(turn.past, dtype="<f4", offset=HEAD.size).reshape(-1, width)[:, 0]
    return [round(float(each), 2) for each in times]


def test_who_comes_later_gets_the_past_once_and_again_when_it_asks() -> None:
    async def test(served: Served) -> None:
        served.running.begin(since_s=10.0)
        for _ in range(3):
            await served.frame()
        async with served.opened() as page:
            await served.frame()
            assert past_rows(await page.turn()) == [10.05, 10.1, 10.15, 10.2]
            await served.frame()
            assert (await page.turn()).past is None
            await page.say({"past": True})
            await until(lambda: next(iter(served.pages._pages)).wants_past)
            await served.frame()
            assert len(past_rows(await page.turn())) == 6
            await served.frame()
            assert (await page.turn()).past is None

    run(test)


# ---------------------------------------------------------------------- each at its own speed


def test_who_draws_nothing_gets_no_more_and_then_the_newest() -> None:
    async def test(served: Served) -> None:
        async with served.opened() as page:
            await served.frame()
            first = [await page.turn(draws=False)]
            for number in range(20):
                served.live.put("count", number)
                served.live.logs["events"].append(number)
                await served.frame()
                if number < AHEAD - 1:
                    first.append(await page.turn(draws=False))
            assert [each.number for each in first] == [1, 2]
            await page.say(AHEAD)
            turn = await page.turn(draws=False)
            assert turn.number == served.live.number == 21
            assert turn.told["parts"]["count"] == 19  # state is replaced
            assert turn.told["logs"]["events"] == [*range(1, 20)]  # what happened is not
            await served.frame()
            assert (await page.turn(draws=False)).number == 22
            await served.frame()
            await served.frame()
            await page.say(AHEAD + 1)
            assert (await page.turn()).number == 24

    run(test)


def test_a_frozen_page_keeps_no_other_waiting() -> None:
    """Not even one that takes nothing from the network, with much on its way to it."""

    async def test(served: Served) -> None:
        served.running.begin()
        await served.frame()
        live = served.live
        width = len(FLEET.ids) * (len(COLUMNS) - FORCE_COLUMNS)
        for number in range(60_000):
            live.history.add(number, np.zeros(width))
        assert len(live.until_now()) > 10_000_000
        frozen = socket.create_connection(("127.0.0.1", served.port))
        try:
            origin = served.server.address.rstrip("/")
            frozen.sendall(
                f"GET /{TALK_PATH} HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nOrigin: {origin}\r\n"
                "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
            )
            text = json.dumps({"token": TOKEN}).encode()
            frozen.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)  # masked with zeros
            await until(lambda: len(served.pages) == 1)
            await served.frame()
            await until(lambda: next(iter(served.pages._pages)).sent == 1)
            live.history.clear()
            async with served.opened() as page:
                for _ in range(40):
                    number = await served.frame()
                    assert (await page.turn()).number == number
            (stuck,) = served.pages._pages - {each for each in served.pages._pages if each.drawn}
            assert stuck.sent == 1
        finally:
            frozen.close()

    run(test)


# ---------------------------------------------------------------------- what a page says


def test_orders_are_taken_as_they_come() -> None:
    async def test(served: Served) -> None:
        async with served.opened() as page:
            await page.say({"order": {"id": "1", "kind": "stop"}})
            await page.say({"order": {"id": "2", "kind": "resume"}, "forces": True})
            await until(lambda: len(noted(served).taken) == 2)
        assert noted(served).taken == [{"id": "1", "kind": "stop"}, {"id": "2", "kind": "resume"}]

    run(test)


WRONG: list[str | bytes] = [
    "",
    "nonsense",
    "{",
    "[" * 5_000,
    '{"a":' * 2_000,
    "[]",
    "null",
    "true",
    "1.5",
    "NaN",
    '"text"',
    "9" * 5_000,
    b'{"order": {"id": "1", "kind": "stop"}}',
    b"\xff\x00",
]


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_nothing_that_a_page_says_ends_its_connection_alone(wrong: str | bytes) -> None:
    async def test(served: Served) -> None:
        async with served.opened() as other, served.opened() as page:
            await page.say(wrong)
            assert (await page.closed())[0] == REFUSED
            await until(lambda: len(served.pages) == 1)
            await served.frame()
            assert (await other.turn()).number == 1
        assert noted(served).taken == []

    run(test)


def test_a_message_that_is_too_long_ends_its_connection_alone() -> None:
    async def test(served: Served) -> None:
        def order(size: int) -> str:
            empty = len(json.dumps({"order": {"id": ""}}))
            return json.dumps({"order": {"id": "x" * (size - empty)}})

        async with served.opened() as other, served.opened() as page:
            await page.say(order(MESSAGE_BYTES_MAX))
            await until(lambda: len(noted(served).taken) == 1)
            await page.say(order(MESSAGE_BYTES_MAX + 1))
            assert (await page.closed())[0] == TOO_LONG
            await served.frame()
            assert (await other.turn()).number == 1
        assert len(noted(served).taken) == 1

    run(test)


def test_where_nothing_may_be_ordered_nothing_is_taken() -> None:
    async def test(served: Served) -> None:
        running = served.running
        running.begin()
        async with served.opened() as page:
            for kind in ("stop", "resume", "leave", "start", "fault"):
                await page.say({"order": {"id": kind, "kind": kind, "robot": 1}, "preview": {"by": {}}})
            await page.say({"forces": True})
            await until(lambda: next(iter(served.pages._pages)).forces)
            await served.frame()
            turn = await page.turn()
            assert "orders" not in turn.told["parts"]
            assert turn.columns == len(COLUMNS)
        assert running.bus.said == []

    run(test, None)
