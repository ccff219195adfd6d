"""Notifications to systemd, sd_notify(3), where a process runs as a unit that wants them."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from types import TracebackType
from typing import Final

from handfast.agent.common.wording import printable

SHARE: Final = 4
"""A loop says that it lives so many times within the time after which it would be killed."""
WAITING_US: Final = 60_000_000
"""That time while somebody else is waited for, in rounds that may take long."""


class SystemdNotifier:
    """Notifies the socket that systemd names in the environment; without one, nobody. A context manager.

    Args:
        environment: that of the process.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # systemd writes an abstract socket's name with an @ where its zero byte is.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        if self._socket is not None:
            self._socket.setblocking(False)  # a loop must not wait for whoever watches it
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        timeout_us = environment.get("WATCHDOG_USEC", "")
        self._timeout_us = int(timeout_us) if watched and timeout_us.isdecimal() else 0
        self._period_ns = self._timeout_us * 1000 // SHARE
        self._due_ns = 0
        self._waits = False

    def _tell(self, text: str) -> None:
        if self._socket is not None:
            with suppress(OSError):  # it is gone, or full: then it hears the next one
                self._socket.sendto(text.encode(), self._address)

    def ready(self) -> None:
        """The process does its work from now on."""
        if self._waits and self._timeout_us:
            self._tell(f"WATCHDOG_USEC={self._timeout_us}")
        self._waits = False
        self._tell("READY=1")

    def waits(self, text: str) -> None:
        """It has begun, and waits as `text` says: that must not look like a start that takes too long."""
        if self._timeout_us:
            self._tell(f"WATCHDOG_USEC={WAITING_US}")
        self._waits = True
        self._tell("READY=1")
        self.says(text)

    def says(self, text: str) -> None:
        """What it is doing, one line for ``systemctl status``; of more lines each would be a notification."""
        self._tell(f"STATUS={printable(text)}")

    def lives(self, now_ns: int) -> None:
        """Said in every round of the loop, by any clock that does not stand still; passed on in time."""
        if self._period_ns and not 0 <= self._due_ns - now_ns <= self._period_ns:
            self._due_ns = now_ns + self._period_ns
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """It was asked to end and is about to."""
        self._tell("STOPPING=1")

    def __enter__(self) -> SystemdNotifier:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._socket is not None:
            self._socket.close()
