"""Tries on a fleet's page what a stranger of the network may try; prints what came of each, as JSON.

Arguments: address of the page, its token, the certificate of the fleet's authority.
"""

from __future__ import annotations

import json
import socket
import ssl
import sys
import time
from http import HTTPStatus
from urllib.parse import urlsplit
from urllib.request import urlopen

from tests.process.page_talk import PATIENCE_S, talked


def fetched(address: str, trusts: ssl.SSLContext) -> str:
    """What there is at the address, for one who trusts these authorities."""
    try:
        with urlopen(address, timeout=PATIENCE_S, context=trusts) as answer:
            return HTTPStatus(answer.status).phrase
    except OSError as error:
        return str(error)


def in_the_clear(address: str) -> str:
    """What HTTP without TLS is answered."""
    asked = urlsplit(address)
    assert asked.hostname is not None
    with socket.create_connection((asked.hostname, asked.port), PATIENCE_S) as plain:
        plain.sendall(f"GET / HTTP/1.1\r\nHost: {asked.netloc}\r\n\r\n".encode())
        try:
            return plain.recv(1000).decode(errors="replace")
        except ConnectionError:
            return ""


def main() -> None:
    address, token, authority = sys.argv[1:]
    trusts = ssl.create_default_context(cafile=authority)
    origin = address.rstrip("/")
    start = {"order": {"id": "evil", "kind": "start", "resume": True, "seen_s": time.time()}}
    found = {
        "its authority": fetched(address, trusts),
        "the world's authorities": fetched(address, ssl.create_default_context()),
        "in the clear": in_the_clear(address),
        "no origin": talked(address, trusts, None, {"token": token}, start),
        "another site": talked(address, trusts, "https://evil.example", {"token": token}, start),
        "another scheme": talked(address, trusts, f"http:{origin[6:]}", {"token": token}, start),
        "no token": talked(address, trusts, origin, start, start),
        "another token": talked(address, trusts, origin, {"token": token[:-1]}, start),
        "the token": talked(address, trusts, origin, {"token": token}),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
