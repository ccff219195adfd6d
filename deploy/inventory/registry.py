"""Which fleets run on this machine, and where their files are: so that a command finds a fleet by its name.

Every run keeps a small file in this user's private folder. The file is locked while the run lives, however
it ends, so that one that is left over is known as such.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Final

from agent.common.wording import show
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet, FleetError
from agent.runtime.runtime_folder import private_folder
from deploy.console.arguments import fleet_path
from deploy.console.data_files import bundled
from deploy.console.wording import NAMES_SHOWN

_PREFIX: Final = "run-"
_SUFFIX: Final = ".json"


class NotRunningError(LookupError):
    """No fleet is meant by what was given, or more than one; the text is one clear message."""


@dataclass(frozen=True, slots=True)
class Running:
    """One run that lives: name of its fleet, its process, its folder, the fleet file that its robots read
    (with the ports they have), when it started (local time, ISO 8601), and the fleet file that it was started
    from, "" where there is none."""

    name: str
    pid: int
    folder: str
    fleet_file: str
    started: str
    source: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.folder}, since {self.started[11:]})"


class Registration:
    """Makes a run known while it lives. A context manager.

    Args:
        name: the fleet's.
        folder, fleet_file: the run's.
        source: the fleet file that it was started from.
    """

    def __init__(self, name: str, folder: Path, fleet_file: Path, source: Path | None = None) -> None:
        about = Running(
            name,
            os.getpid(),
            str(folder.absolute()),
            str(fleet_file.absolute()),
            time.strftime("%Y-%m-%dT%H:%M:%S"),
            "" if source is None else str(source.absolute()),
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
    """This user's runs that live on this machine, by name; removes what others left."""
    found = []
    for path in private_folder().glob(f"{_PREFIX}*{_SUFFIX}"):
        try:
            handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # it ended just now
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            with suppress(ValueError, TypeError):  # of another version of this program
                found.append(Running(**json.loads(os.read(handle, 65_536))))
        else:
            path.unlink(missing_ok=True)
        finally:
            os.close(handle)
    return sorted(found, key=lambda run: (run.name, run.started, run.pid))


def find(what: str) -> Path:
    """The placed fleet file that is meant: of a fleet that runs here by its name, of a run by its folder.

    A fleet file means the run of its fleet here; where there is none it is taken as it is, with its own
    addresses and ports, for a fleet that was started otherwise. So does the name of a bundled fleet. A fleet
    on hosts is not meant by a run here that only has its name: it was started from this file, or drives it.

    Raises:
        NotRunningError: nothing of the kind runs here, or two runs have that name.
        agent.fleet.model.FleetError: it is a fleet file that is not valid.
    """
    path, runs = Path(what), running()
    if path.is_dir():
        here = [run for run in runs if Path(run.folder).resolve() == path.resolve()]
        if here:
            return Path(here[0].fleet_file)
        # Else a folder that happens to have a fleet's name.
        if all(run.name != what for run in runs) and what not in bundled():
            raise NotRunningError(f"no run lives in the folder {path}{_those(runs)}")
    if path.is_file():
        exact = [run for run in runs if Path(run.fleet_file).resolve() == path.resolve()]
        if exact:
            return Path(exact[0].fleet_file)
        fleet = load_fleet(path)
        if _is_on_hosts(fleet):
            runs = [run for run in runs if _started_from(run, path) or _drives_hosts(run)]
        return _only(fleet.fleet.name, runs) or path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise NotRunningError(f"{show(what)[1:-1]}: there is no such file{_those(runs)}")
    found = _only(what, runs)
    if found is None and what in bundled():
        return fleet_path(what)
    if found is None:
        raise NotRunningError(f"no fleet of the name {show(what)} runs here{_those(runs)}")
    return found


def _is_on_hosts(fleet: Fleet) -> bool:
    return any(robot.host is not None for robot in fleet.robots)


def _started_from(run: Running, path: Path) -> bool:
    return bool(run.source) and Path(run.source).resolve() == path.resolve()


def _drives_hosts(run: Running) -> bool:
    with suppress(FleetError):  # its file may be gone by now
        return _is_on_hosts(load_fleet(run.fleet_file, recorded=True))
    return False


def _only(name: str, runs: Sequence[Running]) -> Path | None:
    same = [run for run in runs if run.name == name]
    if len(same) > 1:
        folders = "\n".join(f"  {run.folder} (since {run.started[11:]})" for run in same)
        raise NotRunningError(
            f"{len(same)} fleets of the name {name} run here: give the folder of one\n{folders}"
        )
    return Path(same[0].fleet_file) if same else None


def _those(runs: Sequence[Running]) -> str:
    if not runs:
        return "; no fleet runs here"
    shown = ", ".join(map(str, runs[:NAMES_SHOWN]))
    more = f" and {len(runs) - NAMES_SHOWN} more" if len(runs) > NAMES_SHOWN else ""
    return f"; running here: {shown}{more}"
