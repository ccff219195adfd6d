"""Has the router of a host start, and waits until it runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.setup import Prepared

LOOK_S: Final = 0.2


def start_router(
    connection: HostConnection,
    fleet: str,
    prepared: Prepared,
    timeout_s: float,
    ended: Callable[[], bool],
) -> None:
    """Has those units of a host's router start that do not run as they should; waits until all of them do.

    Args:
        fleet: its name.
        ended: whether nobody waits for it any more.

    Raises:
        HostError: one does not run; the text says what its process said last.
    """
    names = prepared.stale_router
    if not names:
        return
    before = _processes(connection, fleet)
    connection.ask("units", wanted=prepared.router)
    connection.ask("restart", names=names)
    deadline = time.monotonic() + timeout_s
    while True:
        # A unit that was asked to start again may be seen as it was: another process tells that it has.
        now = _processes(connection, fleet)
        lacking = [name for name in names if not _is_new(now.get(name, {}), before.get(name, {}))]
        if not lacking:
            return
        failed = [name for name in lacking if now.get(name, {}).get("ActiveState") == "failed"]
        if failed or ended() or time.monotonic() > deadline:
            break
        time.sleep(LOOK_S)
    name = (failed or lacking)[0]
    lines = connection.ask("last_lines", name=name, count=1)
    state = connection.ask("states", names=[name])[name]
    raise HostError(f"its router is {state}{f': {lines[-1]}' if lines else ''}")


def _processes(connection: HostConnection, fleet: str) -> Mapping[str, Mapping[str, Any]]:
    found: Mapping[str, Mapping[str, Any]] = connection.ask("status", fleet=fleet)["units"]
    return found


def _is_new(about: Mapping[str, Any], before: Mapping[str, Any]) -> bool:
    return about.get("ActiveState") == "active" and about.get("MainPID") != before.get("MainPID", "0")
