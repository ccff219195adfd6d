"""The process of a Dask worker on a host: ``python -m handfast.deploy.cluster.worker_process``.

It reads one line of JSON from standard input, its settings, with certificates that never are in a file; it
ends with all that it has started when that input does. A nanny of Dask's starts the worker again when it
dies.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from typing import Any, Final

import distributed
from distributed.security import Security

DEATH_TIMEOUT_S: Final = 60.0
"""A worker that does not find its scheduler for so long ends."""


def security(key: str, certificate: str) -> Security:
    """Who has this key and certificate, both PEM, may speak to each other, and nobody else."""
    roles = ("client", "scheduler", "worker")
    pems: dict[str, Any] = {f"tls_{role}_key": key for role in roles}
    pems |= {f"tls_{role}_cert": certificate for role in roles}
    return Security(tls_ca_file=certificate, require_encryption=True, **pems)


async def serve(settings: Mapping[str, Any]) -> None:
    """Has a worker work until its scheduler is gone.

    Args:
        settings: `scheduler`, its address; `host`, where the worker listens; `name`; `threads`, how many runs
            at a time; `folder`, for its files; `key` and `certificate`.
    """
    nanny = distributed.Nanny(
        settings["scheduler"],
        nthreads=settings["threads"],
        host=settings["host"],
        name=settings["name"],
        local_directory=settings["folder"],
        security=security(settings["key"], settings["certificate"]),
        memory_limit=0,  # runs are in other processes, which Dask does not count
        death_timeout=DEATH_TIMEOUT_S,
        dashboard=False,
    )
    async with nanny:
        await nanny.finished()


def end_with_input() -> None:
    """Waits for the end of standard input, then ends this process group."""
    while sys.stdin.read(1):
        pass
    os.killpg(0, signal.SIGKILL)


def main() -> None:
    settings = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_input, daemon=True).start()
    asyncio.run(serve(settings))


if __name__ == "__main__":
    main()
