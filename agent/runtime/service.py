"""A process as a service: notifications to systemd (sd_notify(3)), requests to end, and waiting for a
certificate to be valid.

A computer that was off for months, or has no clock of its own, must come back without anybody at its side: a
process waits until its certificate has been renewed, or until the clock is right.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from argparse import ArgumentParser
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.security.credentials import CredentialsError, NotValidNowError, load
from handfast.agent.security.identity import Identity

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


LOOK_S: Final = 1.0
"""How often the certificate is looked at again."""
POLL_S: Final = 0.1
SAY_S: Final = 60.0
"""How often it is said that the process still waits."""
WAITS: Final = "waiting until it is renewed (`handfast up`), or the clock is set"


def wait_until_valid(
    identity: Identity | None,
    folder: str | Path | None,
    asked_to_end: Callable[[], bool],
    service: SystemdNotifier,
    log: Callable[[str], None],
) -> None:
    """Returns at once, unless the certificate of `identity` is good but for the time; then when it is, or
    when the process is asked to end. Whatever else is wrong with it is not looked at here.

    Args:
        identity: None in a fleet that is not secured.
        folder: with its key and certificates; None for none.
    """
    if identity is None or folder is None:
        return
    say_due_s: float | None = None
    while (why := _not_valid_now(identity, Path(folder))) and not asked_to_end():
        now_s = time.monotonic()
        if say_due_s is None:
            service.waits(f"{why}: waiting")
        if say_due_s is None or now_s >= say_due_s:
            log(f"{why}; {WAITS}")
            say_due_s = now_s + SAY_S
        while time.monotonic() < now_s + LOOK_S and not asked_to_end():
            service.lives(time.monotonic_ns())
            time.sleep(POLL_S)
    if say_due_s is not None and not why:
        log("its certificate is valid now")


def _not_valid_now(identity: Identity, folder: Path) -> str:
    try:
        load(folder, identity, time.time())
    except NotValidNowError as error:
        return str(error)
    except CredentialsError:
        return ""  # for those to say who open the bus
    return ""


PARENT_PERIOD_NS: Final = 2 * NS_PER_S // 5
"""How often is looked for the parent process, ns."""


class Shutdown:
    """Whether the process was asked to end: by SIGTERM, SIGINT or SIGHUP (unless that is ignored, as nohup(1)
    has it), or because its parent is gone.

    A signal handler only sets a flag: Zenoh must be closed by the main thread.

    Args:
        with_parent: the process with which it ends, by its number: it may be gone already. 0: the one that is
            its parent now; None: none.
    """

    def __init__(self, *, with_parent: int | None) -> None:
        self.asked = False
        self.why = ""
        self._parent = None if with_parent is None else with_parent or os.getppid()
        ignores_hangup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        for number in (signal.SIGTERM, signal.SIGINT, *([] if ignores_hangup else [signal.SIGHUP])):
            signal.signal(number, self._on_signal)
        self.look_for_parent()

    def _on_signal(self, number: int, _frame: object) -> None:
        self.asked, self.why = True, signal.Signals(number).name
        self.look_for_parent()  # its end may be why the kernel sent it

    def look_for_parent(self) -> None:
        """Asks the process to end when its parent is gone, if it is to end with it."""
        if self._parent is not None and os.getppid() != self._parent:
            self.asked, self.why = True, "the process that started it is gone"


def add_parent_argument(parser: ArgumentParser) -> None:
    """Has a process's command line take what `Shutdown` has as `with_parent`, as ``exit_with_parent``."""
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=0,
        metavar="PID",
        help="end when the process that started it is gone, whose number may be given",
    )
