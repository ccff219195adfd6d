"""The connection to a Dask scheduler, which is made, used and left within bounded time, whatever is there.

What listens at a port may be no scheduler, or one that stands still. Dask's own time limit is of single steps
of the way to it, and its calls hear no Ctrl-C.
"""

from __future__ import annotations

import asyncio
import time
import warnings
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final, TypeVar

import distributed
from distributed.security import Security
from distributed.versions import VersionMismatchWarning

from handfast.agent.common.errors import Error
from handfast.deploy.cluster.reasons import error_line, why_not
from handfast.deploy.simulate.worker_pool import POLL_S, GoOn

CONNECT_S: Final = 10.0
"""Within this there is a connection, or it is given up."""
SPARE_S: Final = 1.0
"""So much longer than Dask is told to take: what it says of a port where nobody listens tells more."""
CLOSE_S: Final = 5.0

T = TypeVar("T")


class ClusterError(Error):
    """The cluster cannot be used; the text is one line."""


class GivenUp(Exception):
    """What was waited for is not wanted any more."""


class Client(distributed.Client):
    """Dask's client, which is made without a connection: `connect` makes that."""

    def start(self, **_: Any) -> None:
        """Nothing: what Dask calls as a client is made would wait for a connection without end."""

    def connect(self, go_on: GoOn) -> None:
        """Connects.

        Raises:
            TimeoutError: what is there does not answer, or does not as a scheduler does.
            GivenUp: `go_on` said no.
            Exception: whatever else Dask raises.
        """
        with warnings.catch_warnings():
            # A table of ten lines for a worker that differs in anything: of what matters there is a line.
            warnings.simplefilter("ignore", VersionMismatchWarning)
            self._loop_runner.start()
            begin = partial(self._start, timeout=CONNECT_S)
            self.sync(patiently, begin, CONNECT_S + SPARE_S, go_on)  # type: ignore[no-untyped-call]

    def leave(self) -> None:
        """Closes it, whatever state it is in, and waits for nobody for long."""
        with suppress(Exception):  # of a scheduler that is gone
            self.close(timeout=CLOSE_S)  # type: ignore[no-untyped-call]
        self.status = "closed"  # else Dask would try again, and wait, as it is collected


@contextmanager
def connected(address: str, security: Security, name: str, go_on: GoOn) -> Iterator[Client]:
    """A client of the scheduler at `address`, which messages call `name`.

    Raises:
        ClusterError: there is none.
        GivenUp: `go_on`, which is asked a few times a second meanwhile, said no.
    """
    made: Callable[..., Client] = Client
    try:
        client: Client = made(address, timeout=CONNECT_S, security=security, set_as_default=False)
    except Exception as error:  # of certificates, or of Dask's configuration
        raise ClusterError(f"there is no scheduler at {name}: {error_line(error)}") from None
    try:
        try:
            client.connect(go_on)
        except GivenUp:
            raise
        except Exception as error:  # whatever is said there, to Dask it may mean anything
            raise ClusterError(why_not(address, name, error, CONNECT_S)) from None
        yield client
    finally:
        client.leave()


async def patiently(make: Callable[[], Awaitable[T]], timeout_s: float, go_on: GoOn) -> T:
    """What comes of something that is awaited, for no longer than `timeout_s`.

    It is cancelled then, but not waited for: what does not end by that is left to itself.

    Raises:
        TimeoutError: it takes longer; without a text.
        GivenUp: `go_on` said no.
    """
    task = asyncio.ensure_future(make())
    task.add_done_callback(_looked_at)
    until_s = time.monotonic() + timeout_s
    while not task.done():
        if (over := time.monotonic() > until_s) or not go_on():
            task.cancel()
            raise TimeoutError if over else GivenUp
        await asyncio.wait({task}, timeout=POLL_S)
    return task.result()


def _looked_at(task: asyncio.Future[Any]) -> None:
    """Has asyncio not complain that nobody has asked what came of a task."""
    if not task.cancelled():
        task.exception()
