"""The runs and drives of this user that live on this machine, and where their files are.

Each keeps a small file in this user's private folder. The file is locked while the run lives, however it
ends, so that one that is left over is known as such.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.runtime.runtime_folder import NotPrivateError, private_folder

_PREFIX: Final = "run-"
_SUFFIX: Final = ".json"
_NAME: Final = re.compile(rf"{_PREFIX}(\d{{1,9}})-(\d{{1,18}}){re.escape(_SUFFIX)}")
_ENTRY_BYTES_MAX: Final = 65_536


@dataclass(frozen=True, slots=True)
class Running:
    """One run that lives: name of its fleet, its process, its folder, the fleet file that its robots read
    (with the ports they have), when it started (local time, ISO 8601), the fleet file that it was started
    from, "" where there is none, and whether its robots are others' processes, as `handfast drive` has
    them."""

    name: str
    pid: int
    folder: str
    fleet_file: str
    started: str
    source: str = ""
    attached: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({printable(self.folder)}, since {self.started[11:]})"


class Registration:
    """Makes a run known while it lives. A context manager.

    Args:
        name: the fleet's.
        folder, fleet_file: the run's.
        source: the fleet file that it was started from.
        attached: whether the robots are others' processes.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        fleet_file: Path,
        source: Path | None = None,
        *,
        attached: bool = False,
    ) -> None:
        about = Running(
            name,
            os.getpid(),
            str(folder.absolute()),
            str(fleet_file.absolute()),
            time.strftime("%Y-%m-%dT%H:%M:%S"),
            "" if source is None else str(source.absolute()),
            attached,
        )
        self._path = private_folder() / f"{_PREFIX}{about.pid}-{time.monotonic_ns()}{_SUFFIX}"
        # Under another name until it is complete and locked: nobody may take it for one that is left over.
        hidden = self._path.with_suffix(".new")
        self._handle = os.open(hidden, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._handle, fcntl.LOCK_EX)
        os.write(self._handle, json.dumps(asdict(about)).encode())
        hidden.rename(self._path)

    def __enter__(self) -> Registration:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """The run is over."""
        self._path.unlink(missing_ok=True)
        with suppress(OSError):
            os.close(self._handle)


def running() -> list[Running]:
    """This user's runs that live on this machine, by name."""
    return entries()[0]


def entries() -> tuple[list[Running], list[str]]:
    """This user's runs that live on this machine, by name, and a sentence for each of which no more than that
    is known. Removes what others left."""
    found, unreadable = [], []
    try:
        folder = private_folder()
    except NotPrivateError as error:  # nothing here can be believed; what is on hosts is known all the same
        return [], [f"which fleets run here cannot be told: {error}"]
    for path in sorted(folder.glob(f"{_PREFIX}*{_SUFFIX}")):
        number = _NAME.fullmatch(path.name)
        pid = None if number is None else int(number[1])
        try:
            handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except FileNotFoundError:
            continue  # it ended just now
        except OSError:
            if pid is None or _lives(pid):
                unreadable.append(_unreadable(path, pid))
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            try:
                found.append(_entry(os.read(handle, _ENTRY_BYTES_MAX), pid))
            except (ValueError, TypeError, RecursionError, OSError):
                unreadable.append(_unreadable(path, pid))
        else:
            if number is not None and _wrote(int(number[1]), int(number[2])):
                # An editor put another file in the place of the one that is locked.
                unreadable.append(_unreadable(path, pid))
                continue
            with suppress(OSError):  # what cannot be removed is still known to be nobody's
                path.unlink()
        finally:
            os.close(handle)
    return sorted(found, key=lambda run: (run.name, run.started, run.pid)), unreadable


def _unreadable(path: Path, pid: int | None) -> str:
    """What to say of a run that lives and whose entry says nothing but, by its name, which process it is."""
    who = "a run of this user" if pid is None else f"the run of process {pid}"
    how = "Ctrl-C where it was started" + (f", or `kill -INT {pid}`," if pid is not None else "")
    return f"{who} cannot be told: {path} is damaged, or another version's; {how} stops it"


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def _wrote(pid: int, at_ns: int) -> bool:
    """Whether a process of ours that lives may have made a file at a time of the monotonic clock: it was
    there then. A later one has only its number."""
    try:
        stat = Path(f"/proc/{pid}/stat")
        if stat.stat().st_uid != os.getuid():
            return False
        began_s = int(stat.read_text().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - began_s
    except (OSError, ValueError, LookupError):
        return False
    return time.monotonic() - age_s <= at_ns / NS_PER_S


def _entry(data: bytes, pid: int | None) -> Running:
    """What an entry of a process says; raises ValueError, TypeError or RecursionError where it says
    nothing."""
    run = Running(**json.loads(data))
    texts = (run.name, run.folder, run.fleet_file, run.started, run.source)
    if not (all(isinstance(text, str) for text in texts) and type(run.pid) is int):
        raise TypeError
    if run.pid != pid or "\0" in "".join(texts) or not (run.name + run.started).isprintable():
        raise ValueError
    return run
