"""The vehicles of a fleet before a drive: their bridges run for a while and report what they find."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TextIO

import tomli_w
from rich.console import Console
from rich.table import Table
from rich.text import Text

from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.validation import Malformed
from handfast.agent.runtime.loop import RealClock
from handfast.agent.transport.bus import Bus
from handfast.bridges.mavlink.ardupilot.constants import AVOID_ENABLE, RIGHT_FAILSAFES
from handfast.bridges.mavlink.session.requests import AUDITED
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import aligned, robots
from handfast.deploy.drive.readiness import BLOCKING, OK, WARNING, Line, VehicleChecks, sentences
from handfast.deploy.processes.local import VEHICLE, Processes
from handfast.deploy.processes.placement import Vehicle
from handfast.deploy.recording.run_files import FLEET_FILE

MARKS: Final = {OK: ".", WARNING: "!", BLOCKING: "X"}
LEGEND: Final = f"{MARKS[OK]} ok   {MARKS[WARNING]} warning   {MARKS[BLOCKING]} blocking"
_LEVELS: Final = tuple(MARKS)
_GAP: Final = 2


def matrix(found: Mapping[int, Sequence[Line]], width: int) -> list[str]:
    """Lines of text: a row for each check, a column for each robot, as many side by side as `width` has room
    for; then what is not well, said once of all robots of which it is true, what blocks first.

    Args:
        found: by robot, its lines.
    """
    names = list(dict.fromkeys(line.name for lines in found.values() for line in lines))
    label = max(map(len, ("check", *names)), default=0)
    column = max((len(str(robot)) for robot in found), default=0) + _GAP
    beside = max(1, (width - label) // column)
    ids = list(found)
    out = []
    for first in range(0, len(ids), beside):
        part = ids[first : first + beside]
        out.append("check".ljust(label) + "".join(f"{robot:>{column}}" for robot in part))
        for name in names:
            marks = "".join(_mark(found[robot], name).rjust(column) for robot in part)
            out.append(f"{name:<{label}}{marks}".rstrip())
    return [*out, LEGEND, *_words(found)]


def _mark(lines: Sequence[Line], name: str) -> str:
    """The worst of a check's lines; blank where a robot says nothing of it."""
    levels = [line.level for line in lines if line.name == name]
    return MARKS[max(levels, key=_LEVELS.index)] if levels else ""


def _words(found: Mapping[int, Sequence[Line]]) -> Iterator[str]:
    for level in (BLOCKING, WARNING):
        said = [(line, robot) for robot, lines in found.items() for line in lines if line.level == level]
        yield from (f"{MARKS[level]} {sentence}" for sentence in sentences(said))


TIMEOUT_S: Final = 20.0
"""A vehicle that has said nothing by then is not there."""
BOOT_TIMEOUT_S: Final = 60.0
"""One that was just switched on takes 40 s; by then it is looked at as it is."""
POLL_S: Final = 0.04
END_TIMEOUT_S: Final = 2.0
STYLES: Final = {OK: "green", WARNING: "yellow", BLOCKING: "bold red"}
HEADINGS: Final = ("line", "level", "found", "what to do")
WIDTH: Final = 100
"""Of what is no terminal."""
SIMULATED: Final = "simulated: nothing to check"

Found = dict[int, list[Line]]
"""The lines of each robot, in the fleet's order; of a simulated one there are none of a vehicle."""


class Preflight:
    """Starts the bridges of `fleet` (resolved and placed, with these simulated rovers), and no agents."""

    def __init__(self, fleet: Fleet, vehicles: Sequence[Vehicle], interrupt: Interrupt) -> None:
        self._fleet, self._vehicles, self._interrupt = fleet, vehicles, interrupt
        self._checks = VehicleChecks(fleet)
        self._clock = RealClock()
        self._died: dict[int, Line] = {}

    def run(self) -> Found:
        """What the vehicles tell; ends early when interrupted. Whatever happens, no process is left.

        Raises:
            handfast.agent.transport.bus.BusError: the operator's session cannot be opened.
        """
        vehicles = self._checks.robots
        if vehicles:
            with tempfile.TemporaryDirectory(prefix="handfast-preflight-") as name:
                folder = Path(name)
                fleet_file = folder / FLEET_FILE
                fleet_file.write_text(tomli_w.dumps(to_dict(self._fleet)), encoding="utf-8")
                wanted = [(robot, "plant") for robot in vehicles]
                processes = Processes(
                    self._fleet, fleet_file, lambda log: folder / log, self._vehicles, wanted, look=True
                )
                try:
                    processes.start()
                    self._look(processes)
                finally:
                    processes.end(END_TIMEOUT_S)
        return {robot: self._lines(robot) for robot in self._fleet.ids}

    def _lines(self, robot: int) -> list[Line]:
        if robot in self._died:
            return [self._died[robot]]
        lines = list(self._checks.lines(robot))
        if robot in self._checks.robots and not lines:
            lines = [Line("bridge", BLOCKING, f"said nothing within {TIMEOUT_S:.0f} s", "see its machine")]
        return lines

    def _look(self, processes: Processes) -> None:
        vehicles, name = self._checks.robots, self._fleet.fleet.name
        with Bus(listen=[], connect=[self._fleet.plant_endpoint(robot) for robot in vehicles]) as bus:
            bus.subscribe(key_expressions.checks(name, "*"), 32 * len(vehicles))
            begun = time.monotonic()
            while not self._interrupt.count:
                waited_s = time.monotonic() - begun
                if waited_s > (BOOT_TIMEOUT_S if self._checks.booting(self._died) else TIMEOUT_S):
                    return
                time.sleep(POLL_S)
                now_ns = self._clock.now_ns()
                for key, payload in bus.drain():
                    try:
                        message = decode(payload)
                    except Malformed:
                        continue
                    self._checks.feed(now_ns, key, message)
                for child, how in processes.deaths():
                    self._died[child.robot] = death(child.role, how, child.last_lines())
                if self._checks.complete(now_ns, without=self._died):
                    return


def is_simulated(lines: Sequence[Line]) -> bool:
    """Whether a robot's lines say nothing of a vehicle."""
    return not lines


def death(role: str, how: str, last_lines: Sequence[str]) -> Line:
    """The line for a bridge or a simulated rover that ended."""
    words = f": {last_lines[-1]}" if last_lines else ""
    who = "the simulated rover" if role == VEHICLE else "it"
    return Line("bridge", BLOCKING, f"{who} ended ({how}){words}", "correct the fleet file, or what it names")


def passed(found: Found) -> bool:
    """Whether nothing blocks."""
    return all(line.level != BLOCKING for lines in found.values() for line in lines)


def show(found: Found, stream: TextIO, *, each: bool = False) -> None:
    """One table for all vehicles; of one, or for `each`, a table with all that was found: with colours on a
    terminal, in plain columns elsewhere."""
    console = Console(file=stream) if stream.isatty() else None
    simulated = {robot: lines for robot, lines in found.items() if is_simulated(lines)}
    vehicles = {robot: lines for robot, lines in found.items() if robot not in simulated}
    if len(vehicles) > 1 and not each:
        for text in matrix(vehicles, WIDTH if console is None else console.width):
            print(text, file=stream)
        vehicles = {}
    for robot, lines in vehicles.items():
        if console is None:
            print(f"robot {robot}\n" + "\n".join(columns(lines)), file=stream)
        else:
            console.print(_table(robot, lines))
    for sentence in sentences((line, robot) for robot, lines in simulated.items() for line in lines):
        print(sentence, file=stream)
    if simulated:
        print(f"{robots(simulated)}  {SIMULATED}", file=stream)
    print(summary(found), file=stream)


def _table(robot: int, lines: Sequence[Line]) -> Table:
    table = Table(title=f"robot {robot}", title_justify="left", box=None, pad_edge=False)
    for heading in HEADINGS:
        table.add_column(heading, overflow="fold")
    for line in lines:
        # As texts: [datum] is no markup.
        style = STYLES[line.level]
        table.add_row(Text(line.name), Text(line.level, style), Text(line.found), Text(line.advice))
    return table


def columns(lines: Sequence[Line]) -> list[str]:
    """The lines as text in columns, with their headings."""
    return [f"  {row}" for row in aligned([HEADINGS, *lines])]


def summary(found: Found) -> str:
    """The verdict in one line."""
    blocking = {robot: _names(lines, BLOCKING) for robot, lines in found.items() if _names(lines, BLOCKING)}
    warnings = sum(len(_names(lines, WARNING)) for lines in found.values())
    if blocking:
        same: dict[str, list[int]] = {}
        for robot, names in blocking.items():
            same.setdefault(", ".join(names), []).append(robot)
        return "BLOCKED: " + "; ".join(f"{robots(ids)}: {names}" for names, ids in same.items())
    return "CLEAR" + (f", with {warnings} warning{'s' * (warnings > 1)}" if warnings else "")


def _names(lines: Sequence[Line], level: str) -> list[str]:
    return [line.name for line in lines if line.level == level]


def to_json(fleet: str, found: Found) -> str:
    """All of it for other programs."""
    content: dict[str, Any] = {
        "fleet": fleet,
        "passed": passed(found),
        "robots": [
            {"robot": robot, "simulated": is_simulated(lines), "lines": [line._asdict() for line in lines]}
            for robot, lines in found.items()
        ],
    }
    return json.dumps(content, indent=2, ensure_ascii=False)


def write_parameters(found: Found, fleet: str) -> str:
    """Write the parameters to change of each vehicle as FLEET-parameters/robot-N.param, one file a vehicle.

    Mission Planner, MAVProxy and QGroundControl load lines of NAME,VALUE, and comments that begin a line.
    The files of vehicles with nothing to change are removed.

    Returns:
        The text for the operator; "" if no vehicle needs a change.
    """
    folder = Path(f"{fleet}-parameters")
    written = []
    try:
        for robot, lines in found.items():
            file = folder / f"robot-{robot}.param"
            text = parameter_file(f"robot {robot} of {fleet}", lines)
            if text:
                folder.mkdir(exist_ok=True)
                file.write_text(text, encoding="ascii", errors="replace")
                written.append(robot)
            else:
                file.unlink(missing_ok=True)
    except OSError as error:
        return f"Cannot write parameters to change into {folder}: {(error.strerror or str(error)).lower()}."
    if not written:
        return ""
    return (
        f"{robots(written).capitalize()}: parameters to change are in {folder}/robot-N.param. Load each file "
        "into its vehicle with a ground station, then run preflight again."
    )


def parameter_file(title: str, lines: Sequence[Line]) -> str:
    """Return the content of a vehicle's parameter file; "" if it has no value to set.

    Values are those that are right for every rover. Comments say what is wrong, and what else to look at."""
    settable, others = [], []
    for line in lines:
        if line.level == OK or line.name not in (*AUDITED, AVOID_ENABLE):
            continue
        comment = f"# {printable(str(line))}"
        if line.name in RIGHT_FAILSAFES:
            settable += [comment, f"{line.name},{RIGHT_FAILSAFES[line.name]:g}"]
        else:
            others.append(comment)
    if not settable:
        return ""
    if others:
        others.insert(0, "# These depend on the vehicle and its field. Set them yourself:")
    return "\n".join([f"# Parameters to change, {title} (handfast preflight)", *settable, *others, ""])
