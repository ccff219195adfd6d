"""Somebody who opens connections without a certificate, many a second, from many addresses of this machine.

Arguments: JSON with `targets` (a list of [address, port]), `rate` (connections a second, of all targets
together), `sources` (so many addresses, 127.1.0.1 and on; 0: the usual one) and `kind`: what each says
(`SAYS`). It prints how many it has opened when its standard input ends.
"""

from __future__ import annotations

import json
import os
import resource
import select
import socket
import ssl
import sys
import time
from collections import deque
from contextlib import suppress
from typing import Final

HELD_S: Final = 3.0
"""A connection that nobody closes is held for so long."""
STEP_S: Final = 0.005


def client_hello() -> bytes:
    """The first record of a client that means to go on with TLS 1.3."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        context.wrap_bio(incoming, outgoing).do_handshake()
    return outgoing.read()


SAYS: Final = {
    "hello": client_hello,  # and nothing more: a handshake that is not gone on with
    "broken": lambda: client_hello() + b"\x17\x03\x03\x00\x20" + bytes(32),  # fails at once
    "garbage": lambda: os.urandom(200),
    "silent": lambda: b"",
}


def source(number: int) -> str:
    """An address of this machine's that only the flood has."""
    return f"127.1.{number // 250}.{number % 250 + 1}"


def main() -> None:
    """Runs until standard input ends."""
    options = json.loads(sys.argv[1])
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    says = SAYS[options["kind"]]()
    held: deque[tuple[float, socket.socket]] = deque()
    opened, begun_s = 0, time.monotonic()
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], STEP_S)[0]:
        now_s = time.monotonic()
        while held and now_s - held[0][0] > HELD_S:
            held.popleft()[1].close()
        for _ in range(min(200, int((now_s - begun_s) * options["rate"]) - opened)):
            made = socket.socket()
            made.setblocking(False)
            with suppress(OSError):
                if options["sources"]:
                    made.bind((source(opened % options["sources"]), 0))
                made.connect_ex(tuple(options["targets"][opened % len(options["targets"])]))
                if says:
                    made.send(says)
            opened += 1
            held.append((now_s, made))
    print(opened, flush=True)


if __name__ == "__main__":
    main()
