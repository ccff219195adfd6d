"""Talks with the page of a fleet by TLS as a script of some site, and says what came of it."""

from __future__ import annotations

import asyncio
import json
import ssl
from http import HTTPStatus
from typing import Final

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

PATIENCE_S: Final = 10.0
SHOWN: Final = "shown"


def talked(address: str, trusts: ssl.SSLContext, origin: str | None, *says: object) -> str:
    """What comes of saying this to the fleet: `SHOWN`, or why not.

    Args:
        address: of the page, without its token.
        trusts: the authorities that are trusted.
        origin: the site whose script it is, None for no browser's.
    """
    return asyncio.run(_talked(address, trusts, None if origin is None else Origin(origin), says))


async def _talked(
    address: str, trusts: ssl.SSLContext, origin: Origin | None, says: tuple[object, ...]
) -> str:
    # Not the client of websockets.sync: it reads and writes in two threads, and Python's ssl then loses an
    # answer about once in 2,000 connections.
    live = address.replace("https:", "wss:") + "live"
    try:
        async with connect(live, ssl=trusts, origin=origin, proxy=None) as talk:
            for each in says:
                await talk.send(json.dumps(each))
            said = json.loads(await asyncio.wait_for(talk.recv(), PATIENCE_S))
            return SHOWN if "scene" in said["parts"] else "something else"
    except InvalidStatus as error:
        return HTTPStatus(error.response.status_code).phrase
    except ConnectionClosed as error:
        return error.rcvd.reason if error.rcvd else str(error)
