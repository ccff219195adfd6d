"""Folders that commands make, and the last orders that operators on this machine gave to a fleet on hosts.

Robots keep orders too (`agent.runtime.order_store`). Where none of those that have kept a stop are left, as
after a new disk, the machine that gave it still has it, and gives it again.
"""

from __future__ import annotations

import os
import sys
import time
from itertools import chain, count
from pathlib import Path
from typing import Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import as_believed, decode, encode, newer
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.order_store import FILE_BYTES_MAX, OrderFileError, packed, unpacked
from handfast.agent.security.private_files import (
    KeyFileError,
    exists,
    home_folder,
    private_directory,
    read,
    write,
)
from handfast.deploy.console.arguments import InputError


def cache_folder(kind: str) -> Path:
    """Where this user keeps what need not be fetched again."""
    base = os.environ.get("XDG_CACHE_HOME") or str(home_folder() / ".cache")
    return Path(base) / "handfast" / kind


def state_folder(kind: str) -> Path:
    """Where this user keeps what later commands must know."""
    base = os.environ.get("XDG_STATE_HOME", "")
    root = Path(base) if base.startswith("/") else home_folder() / ".local" / "state"
    return root / "handfast" / kind


def out_folder(out: str | Path | None, name: str, above: str = "runs") -> Path:
    """The folder that is named, or one of a name and the time, that is not there yet: two drives may begin
    within a second."""
    if out:
        return Path(out)
    base = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    names = chain([base], (f"{base}-{number}" for number in count(2)))
    return next(path for each in names if not (path := Path(above) / each).exists())


def refuse_full(out: Path) -> None:
    """Refuses what is there and no empty folder; raises `InputError`."""
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out} is not an empty folder: name another one with --out, or remove it")
    except OSError as error:
        raise InputError(f"cannot look into {out}: {(error.strerror or str(error)).lower()}") from None


Order = Mission | Stop | Resume
_KINDS: Final = (Stop, Resume, Mission)


class OwnOrders:
    """The newest stop, resume and mission of `fleet`; of a fleet without hosts, none are kept.

    Attributes:
        trouble: why what was to be kept is not, or could not be read, "" when all is well.
    """

    def __init__(self, fleet: Fleet) -> None:
        on_hosts = any(robot.host is not None for robot in fleet.robots)
        self._path = state_folder("orders") / f"{fleet.fleet.name}.json" if on_hosts else None
        self._known: dict[type[Order], Order] = {}
        self.trouble = ""
        if self._path is not None:
            self._read(self._path)

    def _read(self, path: Path) -> None:
        try:
            kept = unpacked(read(path, most=FILE_BYTES_MAX)) if exists(path) else ()
            found = [order for order in map(decode, kept) if isinstance(order, _KINDS)]
        except (KeyFileError, OrderFileError, Malformed) as error:
            self.trouble = f"what was ordered before is not known here: {path}: {error}"
            return
        # What was given by a clock that was ahead is nothing to go by once that is right.
        believed = [as_believed(order, time.time_ns()) for order in found]
        self._known = {type(order): order for order in believed if order is not None}
        if believed != found:
            self._write()

    @property
    def orders(self) -> tuple[Order, ...]:
        """Those that are known, a stop first."""
        return tuple(self._known[kind] for kind in _KINDS if kind in self._known)

    def keep(self, order: Order) -> None:
        """Keeps an order, if it is newer than the one of its kind that is known."""
        before = self._known.get(type(order))
        if isinstance(order, Mission):
            is_newer = newer(order, before if isinstance(before, Mission) else None)
        else:
            is_newer = before is None or order.version > before.version
        if not is_newer:
            return
        self.put(order)

    def put(self, order: Order) -> None:
        """Keeps an order, whatever of its kind is known."""
        self._known[type(order)] = order
        self._write()

    def _write(self) -> None:
        if self._path is None:
            return
        try:
            private_directory(self._path.parent)
            write(self._path, packed([encode(each) for each in self.orders]), private=True)
            self.trouble = ""
        except KeyFileError as error:
            self.trouble = f"this machine will not remember the order: {error}"

    def warn(self) -> None:
        """Says what is wrong with what is kept here, if anything is."""
        if self.trouble:
            print(f"warning: {printable(self.trouble)}", file=sys.stderr)
