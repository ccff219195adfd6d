"""The agent of a robot that somebody has taken over: it drives as it should, and says more.

Arguments: the path of a datagram socket that it makes, then those of ``python -m handfast.agent``. A datagram
is a key, a zero byte and what to say there; nothing after it declares that the key lives, and takes that
back.
"""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from threading import Thread
from typing import Any

import zenoh

from handfast.agent.__main__ import start
from handfast.agent.runtime import process
from handfast.agent.transport.bus import Bus


def main() -> int:
    """Runs the process; returns its exit status."""
    path, *arguments = sys.argv[1:]
    genuine = process.open_bus

    def opened(*given: Any, **more: Any) -> Bus:
        bus = genuine(*given, **more)
        Thread(target=speak, args=(bus._far, path), daemon=True).start()
        return bus

    process.open_bus = opened
    return process.main(arguments, "python -m handfast.agent", "agent", start)


def speak(session: zenoh.Session, path: str) -> None:
    """Says what comes at `path`, over the links of an honest process and past all that it checks."""
    Path(path).unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(path)
        while True:
            key, _, payload = ear.recv(1 << 18).partition(b"\0")
            if session.is_closed():
                return
            if payload:
                session.put(key.decode(), payload, allowed_destination=zenoh.Locality.REMOTE)
            else:
                session.liveliness().declare_token(key.decode()).undeclare()


if __name__ == "__main__":
    sys.exit(main())
