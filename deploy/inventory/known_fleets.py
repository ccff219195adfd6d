"""Which fleets run on this machine or are up on hosts, and which of them a user means.

Nobody is asked over the network. Fleets of other users of this machine are not among them. Commands for a
running fleet find it here, and report failures in the same words.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Final

from handfast.agent.common.errors import BAD_INPUT, FAILED
from handfast.agent.common.wording import did_you_mean, show
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.fleet.sections import Robot
from handfast.deploy.console.arguments import InputError, fleet_path, refuse_long
from handfast.deploy.console.data_files import bundled
from handfast.deploy.console.wording import NAMES_SHOWN, some
from handfast.deploy.inventory.hosts import located
from handfast.deploy.inventory.registry import FleetUp, Running, entries, fleets_up

NONE: Final = "no fleet runs here"


class NotRunningError(LookupError):
    """No fleet is meant by what was given, or more than one; the text is one clear message."""


class SeveralError(NotRunningError):
    """More than one fleet is meant; `fleets` are all of them."""

    def __init__(self, fleets: Sequence[KnownFleet]) -> None:
        self.fleets: Final = fleets
        super().__init__(self.text())

    def text(self, command: str = "", last: str = "") -> str:
        """What to say, with each fleet as the argument of a command, and a last line."""
        name = self.fleets[0].name
        lines = [f"{len(self.fleets)} fleets of the name {name} run here or are up: say which one"]
        words = [f"{command} {quote(each.selector)}".strip() for each in self.fleets]
        width = max(map(len, words))
        lines += [f"  {word:{width}}  # {each.about}" for word, each in zip(words, self.fleets, strict=True)]
        return "\n".join([*lines, last] if last else lines)


@dataclass(frozen=True)
class KnownFleet:
    """A fleet that somebody may mean.

    Attributes:
        name: its name.
        fleet_file: the fleet as its robots read it.
        runs: processes of this user that run it or drive it, by start; none where it is only up, or was
            started otherwise.
        up: where it is up on hosts, as this operator knows; None where that is not known.
    """

    name: str
    fleet_file: Path
    runs: tuple[Running, ...] = ()
    up: FleetUp | None = None

    @cached_property
    def fleet(self) -> Fleet:
        """What `fleet_file` holds.

        Raises:
            NotRunningError: its process lives, but its file cannot be read any more.
            handfast.agent.fleet.model.FleetError: another file is not valid.
        """
        try:
            return load_fleet(self.fleet_file)
        except FleetError as error:
            if not self.runs:
                raise
            pid = self.runs[-1].pid
            raise NotRunningError(
                f"{error}; {self.name} runs here all the same: Ctrl-C where it was started, or "
                f"`kill -INT {pid}`, stops it"
            ) from None

    @property
    def robots(self) -> Sequence[Robot]:
        """Its robots; none where its file cannot be read."""
        with suppress(FleetError, NotRunningError):
            return self.fleet.robots
        return ()

    @property
    def hosts(self) -> list[str]:
        """Names of the hosts that its robots are on, as far as is known; none where they are here."""
        if self.up is not None:
            return [host.name for host in self.up.hosts]
        return list(dict.fromkeys(robot.host for robot in self.robots if robot.host is not None))

    @property
    def on_hosts(self) -> bool:
        """Whether its robots are on hosts."""
        return bool(self.hosts)

    @property
    def endpoints(self) -> frozenset[str]:
        """Where its agents listen: two fleets of one name that share one are the same. Empty when unknown."""
        return frozenset(self.fleet.agent_endpoint(robot.id) for robot in self.robots)

    @property
    def about(self) -> str:
        """Where it is and since when, in a few words."""
        where = [f"{run.folder}, since {run.started[11:]}" for run in self.runs[-1:]]
        if self.up is not None:
            where.append(f"on {some(self.hosts)}, since {self.up.since.replace('T', ' ')}")
        return "; ".join(where) or str(self.fleet_file)

    @cached_property
    def selector(self) -> str:
        """The shortest argument that means this fleet and no other."""
        words = [
            self.name,
            *(str(run.pid) for run in self.runs[-1:]),
            *(run.folder for run in self.runs[-1:]),
        ]
        if self.up is not None:
            words.insert(1, self.up.source)
        for word in words:
            with suppress(NotRunningError, FleetError, OSError):
                if [each.fleet_file for each in meant(word)] == [self.fleet_file]:
                    return word
        return str(self.fleet_file)

    def __str__(self) -> str:
        return str(self.runs[-1]) if self.runs else str(self.up or self.name)


def known(name: str | None = None) -> list[KnownFleet]:
    """All fleets that run here or are up, or those of a name."""
    found: list[KnownFleet] = [
        KnownFleet(up.name, up.fleet_file, up=up) for up in fleets_up()[0] if name in (None, up.name)
    ]
    for run in entries()[0]:
        if name not in (None, run.name):
            continue
        new = KnownFleet(run.name, Path(run.fleet_file), (run,))
        same = [each for each in found if each.name == run.name]
        # Only where there may be two of one name: reading their files takes its time.
        shared = [len(each.endpoints & new.endpoints) for each in same]
        if not any(shared):
            found.append(new)
            continue
        best = same[shared.index(max(shared))]
        found[found.index(best)] = KnownFleet(run.name, new.fleet_file, (*best.runs, run), best.up)
    return sorted(found, key=lambda each: (each.name, not each.runs, each.about))


def find(what: str) -> KnownFleet:
    """The fleet that is meant by a name, the number or the folder of a run, or a fleet file.

    Raises:
        SeveralError: more than one is meant.
        NotRunningError, handfast.agent.fleet.model.FleetError, handfast.deploy.console.arguments.InputError:
        see `meant`.
    """
    fleets = meant(what)
    if len(fleets) > 1:
        raise SeveralError(fleets)
    return fleets[0]


def meant(what: str) -> list[KnownFleet]:
    """All fleets that may be meant, one at least: those that run here or are up, by name, by the number of a
    run's process, by its folder, or by fleet file.

    A fleet file means what runs of its fleet here; where nothing does it is taken as it is, with its own
    addresses and ports, for a fleet that was started otherwise. So does the name of a bundled fleet. A fleet
    on hosts is not meant by a run here that only has its name: it was started from this file, or drives it.

    Raises:
        NotRunningError: nothing of the kind is known.
        handfast.agent.fleet.model.FleetError: it is a fleet file that is not valid.
        handfast.deploy.console.arguments.InputError: nobody knows where a host of that file is.
    """
    refuse_long(what)
    path = Path(what)
    if path.is_dir():
        inside = _with_run(lambda run: Path(run.folder).resolve() == path.resolve())
        if inside:
            return inside
        # Else a folder that happens to have a fleet's name.
        if not known(what) and what not in bundled():
            raise NotRunningError(f"no run lives in the folder {path}{_those()}")
    if path.is_file():
        return _of_file(path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        lacks = "it is neither a file nor a folder" if path.exists() else "there is no such file"
        raise NotRunningError(f"{show(what)[1:-1]}: {lacks}{_those()}")
    return _of_name(what)


def _of_name(what: str) -> list[KnownFleet]:
    """The fleets of a name, or with a run of this number; the bundled one where none of them runs."""
    found = known(what)
    if not found and what.isdecimal():
        found = _with_run(lambda run: str(run.pid) == what)
    if not found and what in bundled():
        return [KnownFleet(what, fleet_path(what))]
    if not found:
        meant_one = did_you_mean(what, [*bundled(), *(each.name for each in known())])
        asked = f"; {meant_one}" if meant_one else ""
        raise NotRunningError(f"no fleet of the name {show(what)} runs here{_those()}{asked}")
    return found


def unreadable() -> list[str]:
    """Sentences about fleets that are there, or may be, and of which no more is known."""
    return entries()[1] + fleets_up()[1]


def is_driven(folder: Path) -> bool:
    """Whether a process of this user drives what is recorded in `folder`, a run's."""
    return bool(_with_run(lambda run: Path(run.folder).resolve() == folder.resolve()))


def _with_run(look: Callable[[Running], bool]) -> list[KnownFleet]:
    """The fleets that have a run of this kind; with its own file, where several drive them."""
    return [
        KnownFleet(each.name, Path(run.fleet_file), (*(r for r in each.runs if r != run), run), each.up)
        for each in known()
        for run in each.runs
        if look(run)
    ]


def _of_file(path: Path) -> list[KnownFleet]:
    exact = _with_run(lambda run: Path(run.fleet_file).resolve() == path.resolve())
    if exact:
        return exact
    itself = KnownFleet(load_fleet(path).fleet.name, path)
    same = known(itself.name)
    exact = [each for each in same if each.up is not None and each.up.fleet_file.resolve() == path.resolve()]
    if exact or not same:
        return exact or _from(path) or [itself]
    if not itself.on_hosts:
        return [each for each in same if not each.on_hosts] or [itself]
    endpoints = _located_endpoints(itself.fleet)

    def is_it(each: KnownFleet) -> bool:
        started = any(run.source and Path(run.source).resolve() == path.resolve() for run in each.runs)
        return started or (each.on_hosts and bool(endpoints & each.endpoints))

    return list(filter(is_it, same)) or [itself]


def _from(path: Path) -> list[KnownFleet]:
    """The fleets that run or are up from a file, under the name that they had in it then."""
    return [
        each
        for each in known()
        for source in (each.up.source if each.up is not None else "", *(run.source for run in each.runs))
        if source and Path(source).resolve() == path.resolve()
    ]


def _located_endpoints(fleet: Fleet) -> frozenset[str]:
    placed = located(fleet)
    return frozenset(placed.agent_endpoint(robot) for robot in placed.ids)


def _those() -> str:
    """What there is instead, in words."""
    fleets = known()
    text = "; running here: " if any(each.runs for each in fleets) else "; known: "
    shown = ", ".join(map(str, fleets[:NAMES_SHOWN]))
    more = f" and {len(fleets) - NAMES_SHOWN} more" if len(fleets) > NAMES_SHOWN else ""
    text = f"{text}{shown}{more}" if fleets else f"; {NONE}"
    return "; ".join([text, *unreadable()])


MEANING = (
    "FLEET is the name of a fleet that runs on this machine or that was brought up on hosts from here "
    "(`handfast status`), the number of its process, the folder of its run, or a fleet file; the name of a "
    "bundled fleet means its file where no such fleet is known."
)

Command = Callable[[argparse.Namespace], int]


class NoAnswerError(Exception):
    """The fleet cannot be reached; the text is one clear message."""


def running_fleet(what: str) -> Fleet:
    """The fleet that is meant, as its processes read it, with the addresses of its hosts.

    Raises:
        handfast.deploy.inventory.known_fleets.NotRunningError, handfast.agent.fleet.model.FleetError: see
        `deploy.inventory.known_fleets.find`. InputError: nobody knows where a host is.
    """
    from handfast.deploy.inventory.known_fleets import find

    return as_running(find(what))


def as_running(known: KnownFleet) -> Fleet:
    """A known fleet as its processes read it, with the addresses of its hosts; raises as `running_fleet`."""
    from handfast.deploy.inventory.hosts import located

    return located(known.fleet) if known.on_hosts else known.fleet


def handled(command: Command) -> Command:
    """`command`, with what may go wrong with a running fleet said in one line."""

    def run(options: argparse.Namespace) -> int:
        # Here: opening the bus takes its time, and most commands do not.
        from handfast.agent.runtime.order_store import NotPrivateError
        from handfast.agent.transport.bus import BusError
        from handfast.deploy.inventory.known_fleets import NotRunningError

        try:
            return command(options)
        except (FleetError, NotRunningError, NotPrivateError, InputError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return BAD_INPUT
        except (BusError, NoAnswerError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED

    return run
