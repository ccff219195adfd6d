"""What this user has running: runs and drives on this machine, and fleets that are up on hosts.

A run keeps a small file in this user's private folder and locks it while it lives, so that one that is left
over is known as such. `handfast up` notes a host before it changes anything there, and `handfast down`
strikes it out when nothing is left there. What other operators do is not known here.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from handfast.agent.common.closing import Closing
from handfast.agent.common.time import NS_PER_S
from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.order_store import NotPrivateError, private_folder
from handfast.deploy.console.wording import some
from handfast.deploy.inventory.hosts import robots_on

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


class Registration(Closing):
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


FLEET_FILE: Final = "fleet.toml"
_RECORD_FILE: Final = "up.json"
_LOCK_FILE: Final = ".lock"
_RECORD_BYTES_MAX: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class HostUp:
    """A host on which robots are up: its name and address, their ids, since when (local time, ISO 8601), and
    whether the last `up` there came to its end: else they may be up, or some of them."""

    name: str
    address: str
    robots: tuple[int, ...]
    since: str
    complete: bool


@dataclass(frozen=True, slots=True)
class FleetUp:
    """A fleet that is up: its name, the fleet file that it was brought up from, its hosts, and the folder of
    this record."""

    name: str
    source: str
    hosts: tuple[HostUp, ...]
    folder: Path

    @property
    def fleet_file(self) -> Path:
        """The fleet as it was brought up, with the hosts' addresses."""
        return self.folder / FLEET_FILE

    @property
    def since(self) -> str:
        return min(host.since for host in self.hosts)

    @property
    def robots(self) -> list[int]:
        return sorted(robot for host in self.hosts for robot in host.robots)

    def __str__(self) -> str:
        names = some(host.name for host in self.hosts)
        return f"{self.name} (up on {names} since {self.since.replace('T', ' ')})"


def fleets_up() -> tuple[list[FleetUp], list[str]]:
    """All that are up, by name, and a sentence for each record that cannot be read."""
    found, unreadable = [], []
    try:
        folders = sorted(folder for folder in _folder().iterdir() if folder.is_dir())
    except (FileNotFoundError, NotADirectoryError):
        folders = []
    except OSError as error:
        return [], [f"which fleets are up on hosts cannot be told: {error}"]
    for folder in folders:
        try:
            found.append(_read(folder))
        except FileNotFoundError:
            continue  # it went down just now, or is just being noted
        except (OSError, ValueError, TypeError, LookupError, RecursionError):
            unreadable.append(
                f"whether {folder.name.rpartition('-')[0]} is up on hosts cannot be told: "
                f"{folder / _RECORD_FILE} is damaged; when you know that it is down, remove that folder"
            )
    return found, unreadable


def note_up(fleet: Fleet, source: Path, names: Collection[str], *, complete: bool) -> None:
    """Notes that a fleet (resolved and located) is up on its hosts of these names, or is about to be.

    A host that a fleet of this name had before is this one's from now on; it stays up since it was.

    Raises:
        OSError: it cannot be noted.
    """
    hosts = [host for host in fleet.hosts if host.name in names and host.address is not None]
    folder = _folder() / _record_name(fleet)
    with _locked():
        kept: list[HostUp] = []
        since: dict[str, str] = {}
        for other in _of_name(fleet.fleet.name):
            mine = [host for host in other.hosts if _taken(host, hosts)]
            since |= {host.address: host.since for host in mine}
            rest = tuple(host for host in other.hosts if host not in mine)
            if other.folder == folder:
                kept = list(rest)
            elif mine:
                _write_or_remove(replace(other, hosts=rest))
        now = time.strftime("%Y-%m-%dT%H:%M:%S")
        noted = [
            HostUp(
                host.name,
                str(host.address),
                robots_on(fleet, host),
                since.get(str(host.address), now),
                complete,
            )
            for host in hosts
        ]
        folder.mkdir(mode=0o700, exist_ok=True)
        _write(folder / FLEET_FILE, _fleet_text(fleet))
        _write_or_remove(FleetUp(fleet.fleet.name, str(source.absolute()), (*kept, *noted), folder))


def note_down(fleet: Fleet, names: Collection[str]) -> None:
    """Notes that nothing of a fleet (located) is left on its hosts of these names.

    Raises:
        OSError: it cannot be noted.
    """
    if not _folder().is_dir():
        return
    hosts = [host for host in fleet.hosts if host.name in names]
    with _locked():
        for each in _of_name(fleet.fleet.name):
            rest = tuple(host for host in each.hosts if not _taken(host, hosts))
            if rest != each.hosts:
                _write_or_remove(replace(each, hosts=rest))


def _folder() -> Path:
    from handfast.deploy.inventory.own_orders import state_folder  # here: it loads msgpack

    return state_folder("fleets")


def _record_name(fleet: Fleet) -> str:
    """The same for the same hosts: a fleet file may move, and several may have one name."""
    addresses = sorted({str(host.address).lower() for host in fleet.hosts if robots_on(fleet, host)})
    return f"{fleet.fleet.name}-{hashlib.sha256(' '.join(addresses).encode()).hexdigest()[:8]}"


def _taken(host: HostUp, hosts: Sequence[HostSection]) -> bool:
    return any(host.address.lower() == str(other.address).lower() for other in hosts)


def _of_name(name: str) -> list[FleetUp]:
    return [each for each in fleets_up()[0] if each.name == name]


@contextmanager
def _locked() -> Iterator[None]:
    """One change at a time, of whichever command or thread."""
    _folder().mkdir(mode=0o700, parents=True, exist_ok=True)
    handle = os.open(_folder() / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _fleet_text(fleet: Fleet) -> str:
    import tomli_w  # here: only this needs it

    return tomli_w.dumps(to_dict(fleet))


def _write_or_remove(record: FleetUp) -> None:
    """Writes a record; removes one without hosts."""
    if record.hosts:
        about: dict[str, Any] = {"name": record.name, "source": record.source}
        about["hosts"] = [asdict(host) for host in record.hosts]
        _write(record.folder / _RECORD_FILE, json.dumps(about, indent=1))
    else:
        (record.folder / _RECORD_FILE).unlink(missing_ok=True)
        shutil.rmtree(record.folder)


def _write(path: Path, text: str) -> None:
    """Whole or not at all."""
    hidden = path.with_suffix(".new")
    hidden.write_text(text, encoding="utf-8")
    hidden.replace(path)


def _read(folder: Path) -> FleetUp:
    """A record; raises OSError, ValueError, TypeError, LookupError or RecursionError where it is none."""
    with open(folder / _RECORD_FILE, "rb") as file:
        about = json.loads(file.read(_RECORD_BYTES_MAX))
    hosts = tuple(
        HostUp(
            _text(host["name"]),
            _text(host["address"]),
            tuple(int(robot) for robot in host["robots"]),
            _text(host["since"]),
            bool(host["complete"]),
        )
        for host in about["hosts"]
    )
    if not hosts:
        raise ValueError
    return FleetUp(_text(about["name"]), _text(about["source"]), hosts, folder)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value
