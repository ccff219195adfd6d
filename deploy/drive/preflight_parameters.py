"""Failsafe parameters of vehicles before a drive: what to set, what was there before, and how it is said.

The values that a vehicle had are kept in a file of this user's for each robot, before any is changed. The
first ones count until they are set back: who sets twice can still undo the first time. What handfast has set
is kept beside them: a value that is neither is somebody else's, and is left alone.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from agent.security.private_files import KeyFileError, exists, private_directory, read, write
from bridges.mavlink.bridge.parameter_audit import changes
from bridges.mavlink.bridge.parameter_setup import Answer, Task, same
from deploy.console.arguments import InputError
from deploy.console.wording import robots
from deploy.inventory.folders import state_folder

KIND: Final = "parameters"
NOT_DONE: Final = "NOT DONE: "
HEADINGS: Final = ("robot", "parameter", "is", "would be", "why")
AS_BEFORE: Final = "as it was before handfast set it"
CHANGED_SINCE: Final = "changed since by somebody else: left alone"
DAY: Final = re.compile(r"\d{4}-\d\d-\d\d")


class Row(NamedTuple):
    """A parameter of a robot that is to be set."""

    robot: int
    name: str
    value: float
    wanted: float
    why: str


class OldValues:
    """What a robot's vehicle had before handfast set anything, in a file of this user's.

    Attributes:
        path: of that file.
        system: system id of that vehicle, None where no file is there.
        values: by name.
        sent: what handfast has set since, by name, or may have; nothing for what a version of it kept that
            did not write this down.
        written: when the first of them was kept, "" where that is not known.

    Raises:
        InputError: the file is damaged, or others may read it.
    """

    def __init__(self, fleet: str, robot: int) -> None:
        self._fleet, self._robot = fleet, robot
        self.path: Final = state_folder(KIND) / fleet / f"robot-{robot}.json"
        self.system: int | None = None
        self.values: dict[str, float] = {}
        self.sent: dict[str, list[float]] = {}
        self.written = ""
        try:
            if not exists(self.path):
                return
            content = json.loads(read(self.path, private=True))
            self.system = int(content["system"])
            self.values = {str(name): float(value) for name, value in content["values"].items()}
            self.sent = {
                str(name): [float(value) for value in values]
                for name, values in content.get("set", {}).items()
            }
            self.written = str(content.get("written", ""))
        except KeyFileError as error:
            raise InputError(str(error)) from None
        except (ValueError, TypeError, LookupError, AttributeError):
            raise InputError(
                f"the old parameters of robot {robot} cannot be read: {self.path} is damaged: correct it, "
                "or put it away"
            ) from None

    def keep(self, system: int, changes: Mapping[str, tuple[float, float]]) -> list[str]:
        """Keeps values that are about to be changed; of a parameter that is kept already the first counts.

        Args:
            changes: by name, the value that it has and the one that it is to have.

        Returns:
            The names of those that are new.
        """
        new = [name for name in changes if name not in self.values]
        if new and not self.values:
            self.written = time.strftime("%Y-%m-%dT%H:%M:%S")
        self.system = system
        is_other = bool(new)
        for name, (before, wanted) in changes.items():
            if name in new:
                self.values[name], self.sent[name] = before, [wanted]
            elif name in self.sent and not any(same(wanted, each) for each in self.sent[name]):
                self.sent[name].append(wanted)
                is_other = True
        if is_other:
            self._write()
        return new

    def is_ours(self, name: str, value: float) -> bool:
        """Whether that may be what handfast has set, as far as is known."""
        return name not in self.sent or any(same(value, each) for each in self.sent[name])

    def forget(self, names: Iterable[str]) -> None:
        """Forgets values that the vehicle has (again); the file goes with the last one."""
        left = {name: value for name, value in self.values.items() if name not in set(names)}
        if left != self.values:
            self.values = left
            self.sent = {name: values for name, values in self.sent.items() if name in left}
            self._write()

    def _write(self) -> None:
        try:
            if not self.values:
                self.path.unlink(missing_ok=True)
                return
            for folder in (self.path.parent.parent, self.path.parent):
                private_directory(folder)
            content: dict[str, Any] = {
                "fleet": self._fleet,
                "robot": self._robot,
                "system": self.system,
                "written": self.written,
                "values": self.values,
                "set": self.sent,
            }
            write(self.path, json.dumps(content, indent=2).encode() + b"\n", private=True)
        except KeyFileError as error:
            raise InputError(f"nothing more is set: {error}") from None
        except OSError as error:
            raise InputError(f"cannot remove {self.path}: {(error.strerror or str(error)).lower()}") from None


def rows_to_set(answers: Mapping[int, Answer]) -> list[Row]:
    """What is not as it should be, of vehicles that were looked at."""
    return [
        Row(robot, change.name, change.value, change.right, change.why)
        for robot, answer in answers.items()
        for change in changes(answer.values)
    ]


def rows_to_restore(answers: Mapping[int, Answer], old: Mapping[int, OldValues]) -> list[Row]:
    """What is not as it was, but as handfast has set it."""
    return [row for row in _changed(answers, old, AS_BEFORE) if old[row.robot].is_ours(row.name, row.value)]


def changed_since(answers: Mapping[int, Answer], old: Mapping[int, OldValues]) -> list[Row]:
    """What is neither as it was nor as handfast has set it."""
    rows = _changed(answers, old, CHANGED_SINCE)
    return [row for row in rows if not old[row.robot].is_ours(row.name, row.value)]


def _changed(answers: Mapping[int, Answer], old: Mapping[int, OldValues], why: str) -> list[Row]:
    return [
        Row(robot, name, value, before, why)
        for robot, answer in answers.items()
        for name, before in old[robot].values.items()
        if (value := answer.values.get(name)) is not None and not same(value, before)
    ]


def kept_notes(old: Mapping[int, OldValues]) -> list[str]:
    """That values are kept which are not set back, a line for each day on which they were."""
    days: dict[str, list[int]] = {}
    for robot, each in old.items():
        if each.values:
            day = DAY.match(each.written)
            days.setdefault(f" on {day[0]}" if day else "", []).append(robot)
    return [
        f"{robots(ids)}: values from before --set-parameters{on} are kept: "
        "--restore-parameters sets them back"
        for on, ids in days.items()
    ]


def tasks_for(rows: Sequence[Row], answers: Mapping[int, Answer]) -> dict[int, Task]:
    """The tasks that set these, on the vehicles that were looked at."""
    found = {}
    for robot in dict.fromkeys(row.robot for row in rows):
        wanted = {row.name: (row.value, row.wanted) for row in rows if row.robot == robot}
        found[robot] = Task(tuple(wanted), wanted, answers[robot].system)
    return found


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as text in columns, with their headings."""
    texts = [
        HEADINGS,
        *((str(row.robot), row.name, f"{row.value:g}", f"{row.wanted:g}", row.why) for row in rows),
    ]
    widths = [max(len(text[column]) for text in texts) for column in range(len(HEADINGS))]
    return [
        "  ".join(text.ljust(width) for text, width in zip(each, widths, strict=True)).rstrip()
        for each in texts
    ]


def sentences(task: Task, answer: Answer) -> list[str]:
    """What became of a task that sets parameters."""
    if answer.trouble:
        return [f"{NOT_DONE}{answer.trouble}"]
    done = [f"{name} {value:g}" for name, (_, value) in task.wanted.items() if name not in answer.lacking]
    said = [f"set and read back: {', '.join(done)}"] if done else []
    return said + [
        f"{NOT_DONE}{name} {answer.lacking[name]}" for name in task.wanted if name in answer.lacking
    ]
