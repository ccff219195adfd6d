"""The command ``handfast logs``: what the processes of a fleet say, from all hosts, in the order of time; or
from the files of a run on this machine."""

from __future__ import annotations

import argparse
import heapq
import json
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import (
    InputError,
    describe,
    host_argument,
    refuse_hosts,
    robots_argument,
    robots_named,
)
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.times import FORMS, time_option
from handfast.deploy.hosts import systemd_units
from handfast.deploy.inventory import hosts
from handfast.deploy.inventory.hosts import allow_many, hosts_of, located, robots_on
from handfast.deploy.inventory.known_fleets import MEANING, KnownFleet, NotRunningError, find, handled
from handfast.deploy.inventory.registry import running
from handfast.deploy.processes.running import LogFile, log_files
from handfast.deploy.recording.run_files import FLEET_FILE, LOG_FOLDER

FOLLOWED_LINES: Final = 20
"""Lines of each host that are shown before those that are followed."""
HOLD_S: Final = 0.6
"""Lines that are followed wait so long for earlier ones of other hosts."""
LOOK_S: Final = 0.2
"""How often it is looked for Ctrl-C while nothing comes."""
SILENT_S: Final = 20.0
"""A host whose log brings nothing for so long, though it has not ended, is given up."""
CLOSE_S: Final = 0.2
# A host must not fill this computer's memory.
LINE_BYTES_MAX: Final = 1_000_000
TEXT_MAX: Final = 4000
"""Characters of a line that are shown."""
WAITING_MAX: Final = 1000
"""Lines of a host that wait, and that are taken at once; the others wait on their host."""
TIME_US_MAX: Final = 10**17
SAID_BYTES_MAX: Final = 20_000


class Line(NamedTuple):
    """One line of a log: wall clock of its host (us), its host, what was said."""

    time_us: int
    host: str
    text: str


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast logs`` takes."""
    describe(
        parser,
        ", merged by the clocks of their hosts; of a run on this machine, also of one that is over, process "
        f"by process from its folder. {MEANING} Exit status: 0 fine; 1 a log cannot be read; 2 bad input; "
        "130 after Ctrl-C.",
    )
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running, or the folder of a run")
    host_argument(parser)
    robots_argument(parser)
    parser.add_argument("-f", "--follow", action="store_true", help="go on with what is said from now on")
    parser.add_argument("--since", metavar="TIME", help=f"from when on: {FORMS} (default: all)")
    parser.add_argument("-n", "--lines", type=int, metavar="N", help="only the last N lines of each")
    parser.set_defaults(command=handled(_logs))


def _logs(options: argparse.Namespace) -> int:
    since_s = time_option(options, "since", time.time())
    if options.lines is not None and options.lines < 0:
        raise InputError(f"--lines must not be negative, got {options.lines}")
    interrupt = Interrupt()
    with interrupt.caught():
        known = _meant(options.fleet)
        fleet = known.fleet
        wanted = set(robots_named(fleet, options) or fleet.ids)
        if not known.on_hosts:
            refuse_hosts(fleet, options)
            return _here(known, wanted, options, interrupt)
        hosts = hosts_of(fleet, str(known.fleet_file), options.hosts)
        fleet = located(fleet)
        allow_many()
        readers = [
            Reader(host, command(fleet, host, robots, since_s, options))
            for host in hosts
            if (robots := [robot for robot in robots_on(fleet, host) if robot in wanted])
            or not options.robots
        ]
        try:
            for line in (
                followed(readers, interrupt) if options.follow else merged(readers, options.lines, interrupt)
            ):
                if interrupt.count:
                    break
                _print(line)
        finally:
            close(readers)
    if interrupt.count:
        return INTERRUPTED
    return FAILED if any(reader.error for reader in readers) else PASSED


def _meant(what: str) -> KnownFleet:
    """The fleet that is meant; the folder of a run may also be that of one that is over.

    Raises: see `deploy.inventory.known_fleets.find`.
    """
    folder = Path(what)
    try:
        return find(what)
    except NotRunningError:
        if not (folder / LOG_FOLDER).is_dir() or not (folder / FLEET_FILE).is_file():
            raise
    return KnownFleet(folder.name, folder / FLEET_FILE)


def _here(
    known: KnownFleet, robots: Collection[int], options: argparse.Namespace, interrupt: Interrupt
) -> int:
    """Prints the logs of these robots' processes from the files that a run on this machine writes.

    Lines of files bear no time: what is there already comes process by process, what is followed as it comes.

    Raises:
        InputError: there are none, or they cannot answer what is asked.
    """
    from handfast.deploy.hosts.status import logs_of  # here: it needs packages that hosts' logs do not

    folder = logs_of(known) if known.runs else known.fleet_file.parent / LOG_FOLDER
    if folder is None or not folder.is_dir():
        raise InputError(
            f"there are no logs of {known.name} here: no `handfast run` has started its processes (of a run "
            "that is over give the folder)"
        )
    if options.since is not None:
        raise InputError("--since: what a run on this machine says bears no time: give --lines N instead")
    count = options.lines
    if options.follow and count is None:
        count = FOLLOWED_LINES
    logs: dict[str, LogFile] = {}
    status = PASSED
    for log in log_files(folder, robots):
        logs[log.name] = log
        try:
            for line in log.last(count, complete=options.follow):
                if interrupt.count:
                    return INTERRUPTED
                print(f"{log.name}: {printable(line)}")
        except BrokenPipeError:  # who reads what is printed is gone, not the log
            raise
        except OSError as error:
            print(f"handfast: {log.name}: cannot read its log: {error}", file=sys.stderr)
            status = FAILED
    while options.follow and not interrupt.count:
        is_over = set(known.runs).isdisjoint(running())
        for new in log_files(folder, robots):
            log = logs.setdefault(new.name, new)
            said: list[str] = []
            with suppress(OSError):
                said += log.lines(complete=not is_over)
            for line in said:
                _print(Line(time.time_ns() // 1000, log.name, printable(line)))
        if is_over:
            return status
        time.sleep(LOOK_S)
    return INTERRUPTED if interrupt.count else status


def command(
    fleet: Fleet,
    host: HostSection,
    robots: Sequence[int],
    since_s: float | None,
    options: argparse.Namespace,
) -> str:
    """The shell command that prints the log on a host, JSON lines."""
    words = ["journalctl", "-q", "--no-pager", "-o", "json", "--output-fields=MESSAGE"]
    if since_s is not None:
        words.append(f"--since=@{int(since_s)}")
    # With --since, journalctl would take the first lines, not the last: they are counted here instead.
    if since_s is not None or (options.lines is None and not options.follow):
        words += ["-n", "all"]
    else:
        words += ["-n", str(FOLLOWED_LINES if options.lines is None else options.lines)]
    if options.follow:
        words.append("-f")
    name = fleet.fleet.name
    units = [
        systemd_units.unit_name(name, robot, role) for robot in robots for role in systemd_units.roles(fleet)
    ]
    if not options.robots and fleet.router_on(host.name) is not None:
        units.append(systemd_units.router_unit_name(name))
    # What systemd says of a unit, and what its process says: by its own mark, since of a process that dies
    # the last lines are not known to be its unit's.
    matches = [f"USER_UNIT={unit}" for unit in units]
    matches += [f"SYSLOG_IDENTIFIER={systemd_units.identifier(unit)}" for unit in units]
    return " ".join([*words, " + ".join(matches)])


class Reader:
    """The log of one host as it comes. `error` says what went wrong when its lines have ended.

    Raises:
        InputError: there is no ssh here, or it cannot be started.
    """

    def __init__(self, host: HostSection, remote: str) -> None:
        self.host = host
        self.error = ""
        self._lines: queue.Queue[Line | None] = queue.Queue(WAITING_MAX)
        self._said = b""
        try:
            self._process = subprocess.Popen(
                hosts.command(host, remote),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except FileNotFoundError:
            raise InputError(hosts.NO_SSH) from None
        except OSError as error:
            why = (error.strerror or str(error)).lower()
            raise InputError(f"{host.name}: {hosts.NOT_STARTED}: {why}") from None
        self._listener = threading.Thread(target=self._listen_errors, daemon=True)
        self._listener.start()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def next(self, timeout_s: float) -> Line | None:
        """The next line; None when there is no more, which is said where it is for a reason.

        Raises:
            queue.Empty: none has come within this time.
        """
        line = self._lines.get(timeout=timeout_s) if timeout_s else self._lines.get_nowait()
        if line is None and self.error:
            print(f"handfast: {self.host.name}: {self.error}", file=sys.stderr, flush=True)
        return line

    def _read(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        with stream:
            while data := stream.readline(LINE_BYTES_MAX):
                line = _parsed(self.host.name, data)
                if line is not None:
                    self._lines.put(line)
        status = self._process.wait()
        self._listener.join(1.0)  # a master connection of ssh's own, which goes on, may hold it open
        if status:
            self.error = hosts.ended(self.host, status, self._said.decode(errors="replace"))
        self._lines.put(None)

    def _listen_errors(self) -> None:
        stream = self._process.stderr
        assert stream is not None
        with stream:
            while data := stream.readline(LINE_BYTES_MAX):
                self._said = (self._said + data)[-SAID_BYTES_MAX:]

    def give_up(self) -> None:
        """Ends it, as it says nothing."""
        self.error = f"it has said nothing for {SILENT_S:.0f} s"
        print(f"handfast: {self.host.name}: {self.error}", file=sys.stderr, flush=True)
        self.kill()

    def kill(self) -> None:
        """Ends it; `wait` sees to what is left."""
        if self._process.poll() is None:
            self._process.kill()

    def wait(self, until_s: float) -> None:
        """Waits until its threads have ended, until a time by the monotonic clock at most."""
        self._process.wait()
        for thread in (self._reader, self._listener):
            thread.join(max(0.0, until_s - time.monotonic()))


def close(readers: Sequence[Reader]) -> None:
    """Ends all of them, in the time that one takes."""
    for reader in readers:
        reader.kill()
    until_s = time.monotonic() + CLOSE_S
    for reader in readers:
        reader.wait(until_s)


def _parsed(host: str, data: bytes) -> Line | None:
    try:
        entry = json.loads(data)
        message = entry.get("MESSAGE")
        if isinstance(message, list):  # bytes that are no text
            message = bytes(message).decode(errors="replace")
        time_us = int(entry["__REALTIME_TIMESTAMP"])
        text = str(message)
        cut = "" if len(text) <= TEXT_MAX else f"... ({len(text)} characters)"
        return Line(time_us, host, printable(text[:TEXT_MAX]) + cut) if 0 <= time_us < TIME_US_MAX else None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        return None


def merged(readers: Sequence[Reader], last: int | None, interrupt: Interrupt) -> Iterator[Line]:
    """All lines in the order of time, until Ctrl-C; of each host the `last` ones only. One that says nothing
    for a while is given up: the others' lines wait for it."""

    def lines(reader: Reader) -> Iterator[Line]:
        waited_s = 0.0
        while not interrupt.count:
            try:
                line = reader.next(LOOK_S)
                waited_s = 0.0
            except queue.Empty:
                waited_s += LOOK_S
                if waited_s > SILENT_S:
                    reader.give_up()
                    return
                continue
            if line is None:
                return
            yield line

    each = [iter(deque(lines(reader), last)) if last is not None else lines(reader) for reader in readers]
    return heapq.merge(*each)


def followed(readers: Sequence[Reader], interrupt: Interrupt) -> Iterator[Line]:
    """Lines as they come, each held back for a moment in which others may bring an earlier one."""
    waiting: list[tuple[Line, float]] = []
    open_readers = list(readers)
    while (open_readers or waiting) and not interrupt.count:
        now = time.monotonic()
        for reader in list(open_readers):
            with suppress(queue.Empty):
                for _ in range(WAITING_MAX):  # one that says more than can be shown does not keep the others
                    if (line := reader.next(0.0)) is None:
                        open_readers.remove(reader)
                        break
                    heapq.heappush(waiting, (line, now + HOLD_S))
        while waiting and (waiting[0][1] <= now or not open_readers):
            yield heapq.heappop(waiting)[0]
        time.sleep(0.05)


def _print(line: Line) -> None:
    seconds, us = divmod(line.time_us, 1_000_000)
    stamp = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(seconds))
    print(f"{stamp}.{us // 1000:03d} {line.host}: {line.text}", flush=True)
