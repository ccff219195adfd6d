"""How long code of others is waited for where a fleet starts, and how much of a period it may take there."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

ANSWER_S: Final = 10.0
"""What takes longer is not waited for."""
SHARE_MAX: Final = 0.25
"""Of a period: the rest is for messages, the safety filter and other processes."""
T = TypeVar("T")

_FORKS: Final = hasattr(os, "fork") and sys.platform != "darwin"  # whose own libraries do not outlive a fork


def answer(what: str, call: Callable[[], T], seconds: float | None = None) -> T:
    """What `call` returns or raises. It runs in a copy of this process, which is killed if it does not end:
    what it changes stays there, and what it returns or raises comes back pickled. An exception that cannot
    be is a RuntimeError of one line. `what` names it in messages.

    Raises:
        TimeoutError: it has not returned within so many seconds, `ANSWER_S` unless given.
        ChildProcessError: it ended its process.
    """
    seconds = ANSWER_S if seconds is None else seconds
    found, error = (_of_copy if _FORKS else _of_thread)(what, call, seconds)
    if error is not None:
        raise error
    return found[0]


def _of_copy(what: str, call: Callable[[], T], seconds: float) -> tuple[list[T], BaseException | None]:
    from multiprocessing.connection import Pipe  # here: only fleets with code of others need it

    reader, writer = Pipe(duplex=False)
    _flush()  # else the copy would write it too
    child = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # other threads do not matter to the copy
            child = os.fork()
        if child == 0:
            _tell(writer, call, seconds)
        writer.close()
        if not reader.poll(seconds):
            raise _late(what, seconds)
        answered: tuple[list[T], BaseException | None] = reader.recv()
        return answered
    except EOFError:
        pass
    finally:
        if child == 0:
            os._exit(1)  # whatever happens: the copy must not go on as if it were this process
        reader.close()
        status = _ended(child) if child is not None else 0
    how = signal.Signals(-status).name if status < 0 else f"status {status}"
    raise ChildProcessError(f"{what} ended its process ({how})")


def _tell(writer: Connection, call: Callable[[], T], seconds: float) -> None:
    """Sends what `call` returns or raises, and ends this process."""
    from multiprocessing.reduction import ForkingPickler

    from handfast.agent.common.plugins import blame

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds + 1.0)  # ends it also if nobody is left to kill it
    given: tuple[list[T], BaseException | None]
    try:
        given = [call()], None
    except BaseException as error:  # is raised where it was asked for
        given = [], error
    try:
        ForkingPickler.loads(sent := ForkingPickler.dumps(given))
    except Exception as error:
        sent = ForkingPickler.dumps(([], RuntimeError(blame(given[1] or error))))
    writer.send_bytes(sent)
    _flush()
    os._exit(0)


def _ended(child: int) -> int:
    """The exit status of a child, which is killed unless it has ended; -n for the signal n."""
    try:
        os.kill(child, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    except (ProcessLookupError, ChildProcessError):  # where nobody waits for children
        return 0


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # of a stream that is closed, or that nobody reads
            stream.flush()


def _of_thread(what: str, call: Callable[[], T], seconds: float) -> tuple[list[T], BaseException | None]:
    """The same in a thread, which is left behind if it does not end, and does not outlive the process."""
    found: list[T] = []
    raised: list[BaseException] = []

    def ask() -> None:
        try:
            found.append(call())
        except BaseException as error:  # is raised where it was asked for
            raised.append(error)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(seconds)
    if not found and not raised:
        raise _late(what, seconds)
    return found, raised[0] if raised else None


def _late(what: str, seconds: float) -> TimeoutError:
    return TimeoutError(f"{what} did not return within {seconds:g} s")
