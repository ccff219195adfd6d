"""``python -m tests.benchmarks.view_clients ADDRESS COUNT FROZEN``: pages of a fleet as a browser has them,
but without drawing; the last FROZEN of them read nothing any more once they are there."""

from __future__ import annotations

import asyncio
import json
import sys

from websockets.asyncio.client import ClientConnection, connect


async def _page(address: str, token: str) -> None:
    async with _opened(address, token) as talk:
        frames = 0
        async for said in talk:
            if isinstance(said, bytes):
                frames += 1
                await talk.send(str(frames))


async def _frozen(address: str, token: str) -> None:
    async with _opened(address, token) as talk:
        talk.transport.pause_reading()
        await asyncio.get_running_loop().create_future()


class _opened:  # noqa: N801 (used as a function)
    def __init__(self, address: str, token: str) -> None:
        self._token = token
        origin = address.rstrip("/")
        self._connect = connect(
            origin.replace("http", "ws", 1) + "/live",
            origin=origin,  # type: ignore[arg-type]
            proxy=None,
            compression=None,
            ping_interval=None,
            max_size=None,
        )

    async def __aenter__(self) -> ClientConnection:
        talk = await self._connect.__aenter__()
        await talk.send(json.dumps({"token": self._token}))
        return talk

    async def __aexit__(self, *error: object) -> None:
        await self._connect.__aexit__(*error)  # type: ignore[arg-type]


async def _main(address: str, count: int, frozen: int) -> None:
    address, _, token = address.partition("#token=")
    pages = [_page(address, token) for _ in range(count - frozen)]
    await asyncio.gather(*pages, *(_frozen(address, token) for _ in range(frozen)), return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
