"""What a robot's process does while its certificate is not valid: it waits until it has been renewed, or
until this computer's clock is right.

A computer that was off for months, or has no clock of its own, must come back without anybody at its side: a
process that gave up would never look again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from handfast.agent.runtime.systemd_notify import SystemdNotifier
from handfast.agent.security.credentials import CredentialsError, NotValidNowError, load
from handfast.agent.security.identity import Identity

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
