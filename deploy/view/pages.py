"""Talks with the pages that show a running fleet.

A page gets state, which is replaced and never queued: what is new since the last turn, then the newest frame.
The next turn comes when it has drawn all but `AHEAD` frames. So one that is slow, hidden or frozen gets less,
and keeps nobody waiting. What it orders it says again until that is among the orders which it is told of.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from hmac import compare_digest
from typing import Any, Final, Protocol

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from handfast.deploy.view.live_fleet import FRAME_NS, LiveFleet
from handfast.deploy.view.server import keep

AHEAD: Final = 2
"""So many frames are on their way to a page at most."""
PAGES_MAX: Final = 20
TOKEN_S: Final = 5.0
"""Who has not shown the token by then is gone."""
REQUESTS_MAX: Final = 30
"""More requests than that within a second end the connection."""
REFUSED: Final = 1008
FULL: Final = 1013
HURRIED: Final = 4029
"""Why a connection is closed (RFC 6455): for good, for now, and for a page that may come again at once."""
LATE_S: Final = 1.0
"""After a step that came so late the next ones are not hurried."""


class Orders(Protocol):
    """Takes what pages order."""

    def take(self, content: Mapping[str, Any]) -> None:
        """Takes an order, once or again."""
        ...

    async def preview(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """What would come of a formation whose places are dragged."""
        ...


class _Page:
    """One page: what it has, and what it has been sent."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection: Final = connection
        self.wake: Final = asyncio.Event()
        self.asks: Final = asyncio.Event()
        self.question: Mapping[str, Any] = {}
        """The newest that it has asked `Orders.preview`."""
        self.forces = self.wants_past = False
        self.sent = self.drawn = 0
        self._frame = 0
        self._drive = -1
        self._versions: dict[str, int] = {}
        self._told: dict[str, int] = {}
        self._requests: deque[float] = deque(maxlen=REQUESTS_MAX)

    def is_due(self, live: LiveFleet) -> bool:
        """Whether there is a frame that it does not have, and it has drawn those before."""
        return live.number != self._frame and self.sent - self.drawn < AHEAD

    def news(self, live: LiveFleet) -> str:
        """What is new since the last turn, "" when nothing is but the frame."""
        fields = []
        if self._drive != live.drive:
            self._drive = live.drive
            self._told.clear()
            fields.append(f'"drive":{live.drive}')
        parts = [
            f'"{name}":{text}'
            for name, (version, text) in live.parts.items()
            if self._versions.get(name) != version
        ]
        self._versions = {name: version for name, (version, _) in live.parts.items()}
        logs = [
            f'"{name}":{json.dumps(log[self._told.get(name, 0) :], separators=(",", ":"))}'
            for name, log in live.logs.items()
            if len(log) > self._told.get(name, 0)
        ]
        self._told = {name: len(log) for name, log in live.logs.items()}
        fields += [f'"parts":{{{",".join(parts)}}}'] if parts else []
        fields += [f'"logs":{{{",".join(logs)}}}'] if logs else []
        return f"{{{','.join(fields)}}}" if fields else ""

    async def turn(self, live: LiveFleet) -> None:
        """Sends what is new, and the newest frame."""
        wants_past = self.wants_past or self._drive != live.drive
        self.wants_past = False
        self.sent += 1
        self._frame = live.number
        # Made before anything is awaited: all of it is of one moment.
        text, frame = self.news(live), live.frame(forces=self.forces)
        past = live.until_now() if wants_past and len(live.history) else b""
        if text:
            await self.connection.send(text)
        if past:
            await self.connection.send(past)
        await self.connection.send(frame)

    def may_ask(self, now_s: float) -> bool:
        """Whether this request is not one too many."""
        is_full = len(self._requests) == REQUESTS_MAX
        may = not is_full or now_s - self._requests[0] > 1.0
        self._requests.append(now_s)
        return may


class Pages:
    """All pages of a fleet.

    Args:
        token: without which nobody is told, or may order, anything.
        orders: takes what pages order; None where they may order nothing.
    """

    def __init__(self, live: LiveFleet, token: str, orders: Orders | None) -> None:
        self._live, self._token, self._orders = live, token, orders
        self._pages: set[_Page] = set()
        self.steps: Final[list[Callable[[], None]]] = [live.step]
        """What is done for each frame, one after the other."""

    def take_no_more(self) -> None:
        """From now on nothing can be ordered."""
        self._orders = None

    def __len__(self) -> int:
        return len(self._pages)

    def step(self) -> None:
        """Makes a frame, and has those pages sent what is new that have drawn what they had."""
        for step in self.steps:
            step()
        for page in self._pages:
            page.wake.set()

    async def run(self) -> None:
        """Makes frames until this is cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            self.step()
            due_s = max(due_s + FRAME_NS / 1e9, loop.time() - LATE_S)
            await asyncio.sleep(max(0.001, due_s - loop.time()))

    async def talk(self, connection: ServerConnection) -> None:
        """Holds the conversation with one page."""
        with suppress(ConnectionClosed):
            if not await self._knows_token(connection):
                await connection.close(REFUSED, "another token: open the address that handfast view printed")
                return
            if len(self._pages) >= PAGES_MAX:
                await connection.close(FULL, f"{PAGES_MAX} pages look at this fleet already")
                return
            keep(connection)
            page = _Page(connection)
            self._pages.add(page)
            tasks = [asyncio.create_task(each) for each in (self._send(page), self._answer(page))]
            try:
                await self._hear(page)
            finally:
                self._pages.discard(page)
                for task in tasks:
                    task.cancel()
                for task in tasks:
                    with suppress(asyncio.CancelledError, ConnectionClosed):
                        await task

    async def _knows_token(self, connection: ServerConnection) -> bool:
        try:
            said = await asyncio.wait_for(connection.recv(), TOKEN_S)
        except TimeoutError:
            return False
        content = _content(said)
        given = content.get("token") if isinstance(content, dict) else None
        return isinstance(given, str) and compare_digest(given.encode(errors="replace"), self._token.encode())

    async def _send(self, page: _Page) -> None:
        while True:
            await page.wake.wait()
            page.wake.clear()
            if page.is_due(self._live):
                await page.turn(self._live)

    async def _answer(self, page: _Page) -> None:
        """Answers questions that take a while: of several that wait the newest. Orders do not wait for it."""
        while self._orders is not None:
            await page.asks.wait()
            page.asks.clear()
            found = await self._orders.preview(page.question)
            await page.connection.send(json.dumps({"parts": {"preview": found}}))

    async def _hear(self, page: _Page) -> None:
        loop = asyncio.get_running_loop()
        async for said in page.connection:
            content = _content(said)
            if isinstance(content, int) and not isinstance(content, bool):
                page.drawn = max(page.drawn, min(content, page.sent))
                page.wake.set()
                continue
            if not isinstance(content, dict):
                await page.connection.close(REFUSED, "this is nothing that a page says")
                return
            if not page.may_ask(loop.time()):
                await page.connection.close(HURRIED, f"more than {REQUESTS_MAX} requests a second")
                return
            if isinstance(content.get("forces"), bool):
                page.forces = content["forces"]
                if page.forces:
                    self._live.want_forces()
            if content.get("past") is True:
                page.wants_past = True
            if self._orders is None:
                continue
            if isinstance(content.get("order"), dict):
                self._orders.take(content["order"])
            if isinstance(content.get("preview"), dict):
                page.question = content["preview"]
                page.asks.set()


def _content(said: str | bytes) -> Any:
    """What a page said, None for what is no JSON text."""
    try:
        return json.loads(said) if isinstance(said, str) else None
    except (ValueError, RecursionError):
        return None
