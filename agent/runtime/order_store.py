"""Folders of robots' processes on this machine: one in which they keep operators' orders, so that these
outlive them, and one in which a user's processes find each other (locks, lists, no secrets).

Each process has a file of orders of its own, written by a thread: an agent never waits for a disk.
`STOP_FILE` beside them stops the robots of this computer without a link to them: every process looks for
it. The files hold an order as it came, sealed in a secured fleet.
"""

from __future__ import annotations

import json
import os
import stat
import tempfile
import threading
from base64 import b64decode, b64encode
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final
from zlib import crc32

from handfast.agent.common.time import NS_PER_S
from handfast.agent.security.private_files import KeyFileError, exists, move, private_directory, read, write
from handfast.agent.security.sealed_order import SEALED_BYTES_MAX

STOP_FILE: Final = "stop.json"
FORMAT: Final = 1
ORDERS_MAX: Final = 4
"""The last stop, the last two resumes and the mission."""
FILE_BYTES_MAX: Final = 2 * ORDERS_MAX * SEALED_BYTES_MAX
LOOK_PERIOD_NS: Final = NS_PER_S // 20
RETRY_S: Final = 2.0
"""A disk that could not be written is tried again after this."""
END_S: Final = 1.0
"""A process that ends waits so long for its disk."""

Orders = tuple[bytes, ...]


class OrderFileError(ValueError):
    """A file that holds no orders; the text is one clear line without the file's name."""


def packed(orders: Sequence[bytes]) -> bytes:
    """What a file with these orders holds."""
    texts = [b64encode(order).decode() for order in orders]
    return json.dumps({"format": FORMAT, "orders": texts, "crc32": _checksum(texts)}).encode() + b"\n"


def unpacked(data: bytes) -> Orders:
    """The orders in a file.

    Raises:
        OrderFileError: it is damaged, or of another version.
    """
    try:
        found = json.loads(data)
        texts, form, checksum = found["orders"], found["format"], found["crc32"]
        if form != FORMAT:
            raise OrderFileError(f"its format is {form!r:.20}, this program writes {FORMAT}")
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise OrderFileError("it is damaged: its orders are no texts")
        if checksum != _checksum(texts) or len(texts) > ORDERS_MAX:
            raise OrderFileError("it is damaged: it is not what was written")
        return tuple(b64decode(text, validate=True) for text in texts)
    except OrderFileError:
        raise
    except (ValueError, TypeError, KeyError, RecursionError):
        raise OrderFileError("it is damaged: it is not what was written") from None


def _checksum(texts: Sequence[str]) -> int:
    return crc32("\n".join(texts).encode())


def order_file(folder: Path, robot: int, role: str) -> Path:
    """Where a robot's process keeps its orders."""
    return folder / f"robot-{robot}-{role}.json"


class OrderStore:
    """What one process keeps in `folder`, made if need be. A context manager, whose end waits for the disk.

    Where the folder cannot be made it is said, and nothing is kept until it can be: a robot must not stay
    away for that.

    Args:
        robot, role: whose process it is.
        log: writes a line of the process's log.

    Raises:
        handfast.agent.security.private_files.KeyFileError: the folder is others' as well.
    """

    def __init__(self, folder: Path, robot: int, role: str, log: Callable[[str], None]) -> None:
        self._folder = folder
        try:
            private_directory(folder)
        except KeyFileError as error:
            if folder.is_dir():
                raise
            log(f"{error}: operators' orders are not kept until it can be made")
        self._path, self._log = order_file(folder, robot, role), log
        self._stop_path = folder / STOP_FILE
        self._stop_name = str(self._stop_path)
        self._stop_seen: tuple[int, int, int] | None = None
        self._stop_trouble = ""
        self._look_due_ns = 0
        self._changed = threading.Condition()
        self._wanted: tuple[Orders, Sequence[bytes]] | None = None
        self._ended = False
        self._thread: threading.Thread | None = None
        self._written: Orders | None = None
        self._done: tuple[Orders, str] | None = None

    def __enter__(self) -> OrderStore:
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(END_S)

    # ------------------------------------------------------------------ what is there

    def read(self) -> Orders:
        """The orders that were kept when the process ran last. A file that is damaged is put aside, and
        said: it is as if nothing had been kept."""
        try:
            return self._orders(self._path) if exists(self._path) else ()
        except (KeyFileError, OrderFileError) as error:
            self._log(f"cannot use the orders kept in {self._path}: {error}")
            try:
                move(self._path, self._path.with_suffix(".damaged"))
            except KeyFileError as again:
                self._log(str(again))
            return ()

    def stops(self, now_ns: int) -> Orders:
        """What is in `STOP_FILE`, whenever that is another one than before; looked for now and then.

        Args:
            now_ns: any clock.
        """
        if 0 < self._look_due_ns - now_ns <= LOOK_PERIOD_NS:
            return ()
        self._look_due_ns = now_ns + LOOK_PERIOD_NS
        if not os.access(self._stop_name, os.F_OK):  # as mostly: an exception costs as much as all the rest
            return ()
        try:
            found = os.stat(self._stop_name)
        except OSError:
            return ()
        seen = found.st_mtime_ns, found.st_ino, found.st_size
        if seen == self._stop_seen:
            return ()
        try:
            orders = self._orders(self._stop_path)
        except OrderFileError as error:
            self._log(f"ignored {self._stop_path}: {error}")
            orders = ()
        except KeyFileError as error:
            # It is tried again: what keeps a stop from being read may pass.
            if str(error) != self._stop_trouble:
                self._stop_trouble = str(error)
                self._log(f"cannot read {self._stop_path}: {error}")
            return ()
        self._stop_seen, self._stop_trouble = seen, ""
        return orders

    def _orders(self, path: Path) -> Orders:
        return unpacked(read(path, most=FILE_BYTES_MAX))

    # ------------------------------------------------------------------ what is to be there

    def keep(self, orders: Orders, came: Sequence[bytes]) -> None:
        """Has `orders` kept from now on, as they `came`, in the place of those before."""
        with self._changed:
            self._wanted = orders, came
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="orders", daemon=True)
                self._thread.start()
            self._changed.notify()

    def done(self) -> tuple[Orders, str] | None:
        """What was written last and why it could not be, "" when it was; None when nothing was since."""
        found, self._done = self._done, None
        return found

    def _run(self) -> None:
        trouble = ""
        while True:
            with self._changed:
                self._changed.wait_for(self._has_other, RETRY_S if trouble else None)
                if self._wanted is None or (self._ended and self._wanted[0] is self._written):
                    return
                orders, came = self._wanted
            before = trouble
            try:
                private_directory(self._folder)  # somebody may have removed it
                write(self._path, packed(came), private=True)
                trouble = ""
            except KeyFileError as error:
                trouble = f"not on its disk: {error}"
            if trouble != before:
                self._log(trouble or f"orders are kept again in {self._path}")
            self._written = orders
            self._done = orders, trouble

    def _has_other(self) -> bool:
        return self._ended or (self._wanted is not None and self._wanted[0] is not self._written)


class NotPrivateError(OSError):
    """What is there is no folder, or others may write to it; the text says what to do."""


def private_folder() -> Path:
    """The folder, made if need be. Nobody else may write there, or names in it would be anybody's to take.

    Raises:
        NotPrivateError: somebody else may, or it is no folder.
    """
    folder = Path(tempfile.gettempdir()) / f"handfast-{os.getuid()}"
    with suppress(FileExistsError):  # a file, or a link to nowhere: refused below
        folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise NotPrivateError(
            f"{folder} must be a folder of this user that nobody else may write to: remove it, "
            "or make it so (chmod 700)"
        )
    return folder
