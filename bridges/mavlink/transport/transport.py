"""Carries bytes to and from a vehicle, without ever holding up the loop that steers it.

A lock keeps a connection for one bridge, among the programs of one user on one machine.

pymavlink's own `mavutil` is not used for this: it waits inside its constructor until there is a connection,
prints what goes wrong, opens serial devices without exclusion, and a `udpin` of it sends commands to
everybody who ever sent it a datagram.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from typing import Final, Protocol

from handfast.agent.runtime.order_store import NotPrivateError, private_folder
from handfast.bridges.mavlink.transport.channels import Channel, Serial, Tcp, UdpIn, UdpOut
from handfast.bridges.mavlink.transport.connection_string import Connection, Unusable, parse_connection


class InUse(Unusable):
    """Another process has it; the text names that process."""


def _name(connection: Connection, system: int | None) -> str:
    """Name of the lock's file: the same for all ways to write one connection, as far as can be known."""
    if connection.kind == "serial":
        text = os.path.realpath(connection.device)
    else:
        text = connection.text.replace(":localhost:", ":127.0.0.1:")
        if connection.kind != "udpin" and system is not None:
            text += f"-system-{system}"
    readable = re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")[-60:]
    return f"{readable}-{sha256(text.encode()).hexdigest()[:8]}.lock"


def lock_file(name: str) -> int:
    """Handle of the lock file `name` of this user, which is locked until that is closed, or the process ends,
    however it ends. The file stays: to remove it would be a race with the next holder.

    Raises:
        InUse: another process has it.
        OSError: there is no private folder for locks.
    """
    handle = os.open(private_folder() / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        holder = os.pread(handle, 20, 0).decode("ascii", errors="replace").strip()
        os.close(handle)
        whose = f" (process {holder})" if holder.isdigit() else ""
        raise InUse(f"another handfast program uses it{whose}") from None
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode("ascii"), 0)
    return handle


class ConnectionLock:
    """The lock of a connection, held until `close`, or until the process ends, however it ends.

    Args:
        system: which vehicle behind it is meant, where that is said. A router serves several bridges at one
            place, each for a vehicle of its own; a serial port or a listening one can be had once only.

    Raises:
        InUse: another bridge has it.
        OSError: there is no private folder for locks.
    """

    def __init__(self, connection: Connection, system: int | None = None) -> None:
        self._handle = lock_file(_name(connection, system))

    def close(self) -> None:
        """Lets go."""
        os.close(self._handle)


QUEUE_MAX: Final = 4096
LOOK_MS: Final = 1000
"""While what comes is of no use, it is looked so often whether it still comes."""


@dataclass(frozen=True)
class Timing:
    """How long a transport waits, s.

    Attributes:
        retry_s: until the first attempt to open the connection again; twice that until the next, and so on.
        retry_max_s: at most that until any attempt.
        close_s: for its thread to end, at most.
    """

    retry_s: float = 0.2
    retry_max_s: float = 2.0
    close_s: float = 0.5


TIMING: Final = Timing()


class Transport(Protocol):
    """A connection, open or being opened again and again.

    Attributes:
        trouble: why there is none, or none of use, "" while there is one. Changes at any time.
        transient: whether that trouble may end by itself; else somebody has to change something first.
        epoch: how often it was opened: when it has grown, the session starts afresh (`Session.restart`).
        note: something odd that does not keep it from working, "" when nothing is.
        dropped: how many `send`s went nowhere.
    """

    @property
    def trouble(self) -> str: ...

    @property
    def transient(self) -> bool: ...

    @property
    def epoch(self) -> int: ...

    @property
    def note(self) -> str: ...

    @property
    def dropped(self) -> int: ...

    def receive(self) -> list[tuple[int, bytes]]:
        """What came since the last call, each with its time of arrival (ns, by the clock given)."""
        ...

    def send(self, data: bytes) -> None:
        """Sends, or drops and counts; never waits, never raises."""
        ...

    def close(self) -> None:
        """Gives the connection back."""
        ...


class ThreadedTransport:
    """A `Transport` with one thread, which opens, reads and stamps with times; it never sends.

    The thread wakes up for all that comes, which costs a third of what is done with it. But read once a tick,
    a port that somebody floods loses what the vehicle says: the system keeps some hundred datagrams.

    Args:
        connection: where the vehicle is.
        baud: of a serial device.
        clock: wall time in ns, called from that thread.
        system: the vehicle that is meant, where several are behind one connection (`ConnectionLock`).
    """

    def __init__(
        self,
        connection: Connection,
        baud: int,
        clock: Callable[[], int],
        system: int | None = None,
        *,
        timing: Timing = TIMING,
    ) -> None:
        self.trouble = f"{connection.text} is being opened"
        self.transient = True
        self.epoch = 0
        self.dropped = 0
        self._connection, self._baud, self._clock, self._system = connection, baud, clock, system
        self._timing = timing
        self._queue: deque[tuple[int, bytes]] = deque(maxlen=QUEUE_MAX)
        self._lock = threading.Lock()  # never held while anything waits
        self._channel: Channel | None = None
        self._failure: OSError | None = None
        self._closing = threading.Event()
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_write.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=f"reader of {connection.text}", daemon=True)
        self._thread.start()

    @property
    def note(self) -> str:
        channel = self._channel
        return "" if channel is None else channel.note

    def receive(self) -> list[tuple[int, bytes]]:
        # The thread adds meanwhile, or begins anew with none: then fewer come than there were.
        out: list[tuple[int, bytes]] = []
        for _ in range(len(self._queue)):
            try:
                out.append(self._queue.popleft())
            except IndexError:
                break
        return out

    def send(self, data: bytes) -> None:
        if not data:
            return
        sent = False
        with self._lock:
            if self._channel is not None and self._failure is None:
                try:
                    sent = self._channel.write(data)
                except OSError as error:
                    self._failure = error
                    self._wake()
        if not sent:
            self.dropped += 1

    def close(self) -> None:
        if not self._closing.is_set():
            self._closing.set()
            self._wake()
            self._thread.join(self._timing.close_s)

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            self._wake_write.send(b"x")

    def _run(self) -> None:
        lock: ConnectionLock | None = None
        timing = self._timing
        pause_s = timing.retry_s
        while not self._closing.is_set():
            try:
                if lock is None:
                    lock = ConnectionLock(self._connection, self._system)
                channel = open_channel(self._connection, self._baud)
            except OSError as error:
                self.transient = not isinstance(error, Unusable | NotPrivateError)
                self.trouble = f"cannot open {self._connection.text}: {_reason(error)}"
            except Exception as error:  # this thread must not end without a word
                self.transient = False
                self.trouble = f"cannot open {self._connection.text}: {type(error).__name__}: {error}"
            else:
                if self._read(channel):
                    pause_s = timing.retry_s
            self._closing.wait(pause_s)
            pause_s = min(2.0 * pause_s, timing.retry_max_s)
        if lock is not None:
            lock.close()
        self._wake_read.close()
        self._wake_write.close()

    def _read(self, channel: Channel) -> bool:
        """Reads until the connection ends; returns whether anything came."""
        self._queue.clear()  # of what came before, nothing may be taken for the new session's
        with self._lock:
            self._channel, self._failure = channel, None
        self.trouble = ""
        self.epoch += 1
        came = False
        waker = self._wake_read.fileno()
        poller = select.poll()
        poller.register(channel.fileno(), select.POLLIN)
        poller.register(waker, select.POLLIN)
        try:
            while not self._closing.is_set():
                ready = poller.poll(LOOK_MS if channel.trouble else None)
                if not ready:
                    channel.look(self._clock())
                    self._judge(channel)
                for handle, _ in ready:
                    if handle == waker:
                        self._wake_read.recv(64)
                        if self._failure is not None:
                            raise self._failure
                        continue
                    now_ns = self._clock()
                    data = channel.read(now_ns)
                    if data:
                        self._queue.append((now_ns, data))
                        came = True
                    self._judge(channel)
        except OSError as error:
            self.transient = True
            self.trouble = f"{self._connection.text}: {_reason(error)}"
        finally:
            with self._lock:
                self._channel = None
            channel.close()
        return came

    def _judge(self, channel: Channel) -> None:
        """Tells what the channel says of what comes."""
        said = channel.trouble and f"{self._connection.text}: {channel.trouble}"
        if said != self.trouble:
            self.transient, self.trouble = not said, said


def _reason(error: OSError) -> str:
    text = str(error) if error.errno is None else error.strerror or str(error)
    return text[:1].lower() + text[1:]


def open_channel(connection: Connection, baud: int) -> Channel:
    """Opens a connection; may take seconds.

    Raises:
        OSError: it cannot be opened; the text says why.
    """
    if connection.kind == "udpin":
        return UdpIn(connection)
    if connection.kind == "udpout":
        return UdpOut(connection)
    if connection.kind == "tcp":
        return Tcp(connection)
    return Serial(connection, baud)


def open_transport(
    connection: str,
    baud: int,
    clock: Callable[[], int],
    system: int | None = None,
    *,
    timing: Timing = TIMING,
) -> Transport:
    """Begins to open a connection (`bridges.mavlink.transport.connection_string`) and returns at once.

    Args:
        baud: of a serial device.
        clock: wall time in ns, called from the reader's thread.
        system: the vehicle that is meant, where several are behind one connection (`ConnectionLock`).

    Raises:
        ValueError: it is no connection string.
    """
    return ThreadedTransport(parse_connection(connection), baud, clock, system, timing=timing)
