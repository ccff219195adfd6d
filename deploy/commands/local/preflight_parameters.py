"""``handfast preflight --set-parameters`` and ``--restore-parameters``: shows, asks, sets, reads back."""

from __future__ import annotations

import argparse
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from agent.fleet.mavlink_section import MavlinkSection
from agent.fleet.model import Fleet
from deploy.console.arguments import InputError, fleet_path, load
from deploy.console.interrupt import Interrupt

if TYPE_CHECKING:
    from bridges.mavlink.bridge.parameter_setup import Answer, Task
    from deploy.drive.preflight_parameters import OldValues, Row

    CarryOut = Callable[[Mapping[int, Task]], dict[int, Answer]]

LOOK_S: Final = 0.1
LEFT_ALONE: Final = "no vehicle that is reached by MAVLink: left alone"
YES: Final = "yes"
_CHANGES: Final = ("overrides", "law", "faults", "duration", "seed", "orders")


def set_parameters(options: argparse.Namespace, interrupt: Interrupt) -> int:
    """Sets the failsafes of a fleet's vehicles, or those that they had before; the exit status."""
    from bridges.mavlink.bridge.parameter_audit import LOOKED_AT
    from bridges.mavlink.bridge.parameter_setup import Task
    from deploy.drive.preflight_parameters import (
        NOT_DONE,
        OldValues,
        changed_since,
        kept_notes,
        rows_to_restore,
        rows_to_set,
        table,
        tasks_for,
    )

    if not options.yes and not _is_terminal():
        raise InputError(
            "preflight: nobody can be asked here whether to set them: add --yes, or use a terminal"
        )
    fleet = load(options)
    restoring = options.restore_parameters
    vehicles = [robot.id for robot in fleet.robots if _is_reached(fleet, robot.id)]
    old = {robot: OldValues(fleet.fleet.name, robot) for robot in vehicles}
    noted = {robot: each for robot, each in old.items() if each.values and not restoring}
    for note in kept_notes(noted):
        print(note, flush=True)
    for robot in fleet.ids:
        if robot not in vehicles:
            print(f"robot {robot}: {LEFT_ALONE}")
        elif restoring and not old[robot].values:
            print(f"robot {robot}: nothing was set that is to be set back")
    tasks = {
        robot: Task(tuple(old[robot].values) if restoring else LOOKED_AT, system=old[robot].system)
        for robot in vehicles
        if not restoring or old[robot].values
    }
    if not tasks:
        return PASSED
    carry_out = _way(options, fleet, interrupt)
    found = carry_out(tasks)
    for robot, answer in found.items():
        if answer.trouble:
            print(f"robot {robot}: {NOT_DONE}{answer.trouble}")
    looked = {robot: answer for robot, answer in found.items() if not answer.trouble}
    rows = rows_to_restore(looked, old) if restoring else rows_to_set(looked)
    others = changed_since(looked, old) if restoring else []
    for robot in looked:
        if all(row.robot != robot for row in (*rows, *others)):
            print(f"robot {robot}: {'as it was already' if restoring else 'nothing to set'}")
    if restoring:
        _forget(looked, old)
    passed = len(looked) == len(tasks)
    agreed = not interrupt.count
    if agreed and rows:
        print("\n".join(table(rows)), flush=True)
        agreed = options.yes or _agreed(len(rows), interrupt)
    _leave_alone(others, old, forgotten=agreed)
    if agreed and rows:
        passed &= _set(tasks_for(rows, found), old, carry_out, restoring=restoring)
    elif not agreed:
        print("nothing was set", file=sys.stderr)
        passed = False
    if any(each.values and robot not in noted for robot, each in old.items()) and not restoring:
        folder = next(each.path.parent for each in old.values())
        print(f"what they had before is in {folder}: --restore-parameters sets it back")
    return _ended(interrupt, passed=passed)


def _leave_alone(rows: Sequence[Row], old: Mapping[int, OldValues], *, forgotten: bool) -> None:
    """Says what somebody else has changed since; with all agreed to, what it was before is no longer kept."""
    for row in rows:
        end = f" (before handfast: {row.wanted:g}, no longer kept)" if forgotten else ""
        print(f"robot {row.robot}: {row.name} is {row.value:g}, {row.why}{end}", flush=True)
        if forgotten:
            old[row.robot].forget([row.name])


def kept(fleet: Fleet) -> list[str]:
    """What to say of values that are kept from before parameters of its vehicles were set."""
    from deploy.drive.preflight_parameters import OldValues, kept_notes

    notes: list[str] = []
    old: dict[int, OldValues] = {}
    for robot in fleet.ids:
        if _is_reached(fleet, robot):
            try:
                old[robot] = OldValues(fleet.fleet.name, robot)
            except InputError as error:
                notes.append(f"robot {robot}: {error}")
    return notes + kept_notes(old)


def _ended(interrupt: Interrupt, *, passed: bool) -> int:
    if interrupt.count:
        return INTERRUPTED
    return PASSED if passed else FAILED


def _set(
    tasks: Mapping[int, Task], old: Mapping[int, OldValues], carry_out: CarryOut, *, restoring: bool
) -> bool:
    """Sets them and says what became of each; whether all are as they were to be."""
    from deploy.drive.preflight_parameters import sentences

    new: dict[int, list[str]] = {}
    if not restoring:
        for robot, task in tasks.items():
            assert task.system is not None
            new[robot] = old[robot].keep(task.system, task.wanted)
    answers = carry_out(tasks)
    for robot, answer in answers.items():
        for sentence in sentences(tasks[robot], answer):
            print(f"robot {robot}: {sentence}", flush=True)
        if not restoring and answer.trouble:  # nothing was set
            old[robot].forget(new[robot])
    _forget(answers, old, None if restoring else new)
    return not any(answer.trouble or answer.lacking for answer in answers.values())


def _forget(
    answers: Mapping[int, Answer],
    old: Mapping[int, OldValues],
    only: Mapping[int, list[str]] | None = None,
) -> None:
    """Forgets old values that vehicles have, as they said last; of these names alone where some are given."""
    from bridges.mavlink.bridge.parameter_setup import same

    for robot, answer in answers.items():
        before = old[robot].values
        has = [
            name
            for name in (before if only is None else only[robot])
            if name in before and (value := answer.values.get(name)) is not None and same(value, before[name])
        ]
        old[robot].forget(has)


def _is_reached(fleet: Fleet, robot: int) -> bool:
    section = fleet.robot(robot).section(MavlinkSection)
    return section is not None and section.connection is not None and not fleet.robot(robot).is_simulated


def _way(options: argparse.Namespace, fleet: Fleet, interrupt: Interrupt) -> CarryOut:
    """How vehicles are spoken to: from here, or on their hosts.

    Raises:
        InputError: that cannot be now.
    """
    if all(robot.host is None for robot in fleet.robots):
        from agent.runtime.clock import RealClock
        from bridges.mavlink.bridge.parameter_setup import carry_out

        return lambda tasks: carry_out(fleet, tasks, RealClock(), lambda: interrupt.count > 0)
    from deploy.hosts.parameters import carry_out_on_hosts, refusal
    from deploy.inventory.hosts import located

    refuse_changes(options)
    file, placed = str(fleet_path(options.fleet)), located(fleet)
    if why := refusal(placed, file):
        raise InputError(f"preflight: {why}")
    print("their bridges end while vehicles are looked at and set, and start again", file=sys.stderr)
    return lambda tasks: carry_out_on_hosts(placed, tasks, file, interrupt)


def refuse_changes(options: argparse.Namespace) -> None:
    """`InputError` where a fleet on hosts is to be another one than its robots have read."""
    for name in _CHANGES:
        if getattr(options, name):
            option = "--set" if name == "overrides" else f"--{name}"
            raise InputError(
                f"preflight: {option} changes the fleet file, which the bridges on its hosts have read "
                f"already: change the file and say `handfast up {options.fleet}`"
            )


def _is_terminal() -> bool:
    return sys.stdin.isatty()


def _agreed(count: int, interrupt: Interrupt) -> bool:
    """Asks whether to go on; anything but yes, and Ctrl-C, is no."""
    what = "this parameter" if count == 1 else f"these {count} parameters"
    print(f"Set {what}? Type {YES} to go on: ", end="", flush=True)
    while not interrupt.count:
        if select.select([sys.stdin], (), (), LOOK_S)[0]:
            return sys.stdin.readline().strip().lower() == YES
    print()
    return False
