"""Checks across the fields of faults: what is valid field by field, but does not go together (PURE)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handfast.agent.common.reader import Reader
from handfast.agent.common.wording import show
from handfast.agent.fleet.fault_rules import (
    ACTION_FIELDS,
    CLOCK_FIELDS,
    EFFECTS,
    PROCESS_FIELDS,
    SENSOR_FIELDS,
    Effect,
)


def check_faults(faults: Mapping[str, Any], ids: Sequence[int], reader: Reader) -> None:
    """Adds what is wrong with valid values that do not go together; `ids` are the fleet's robots."""
    names: dict[str, int] = {}
    for number, row in enumerate(faults.get("rules", ()), 1):
        if not row:
            continue
        place = f"faults.rule[{number}]"
        name = row.get("name")
        if name and names.setdefault(name, number) != number:
            reader.add(f"{place}.name", f"faults.rule[{names[name]}] has the name {show(name)} already")
        _check_where(row, place, ids, reader)
        _check_when(row, place, reader)
        _check_actions(row, place, reader)
        _check_what(row, place, reader)


def _check_where(row: Mapping[str, Any], place: str, ids: Sequence[int], reader: Reader) -> None:
    robots = row.get("robot")
    named = {
        "link": row["link"].named() if row.get("link") else set(),
        "partition": row["partition"].named() if row.get("partition") else set(),
        "robot": {robots} if isinstance(robots, int) else {r for r in robots or () if r is not None},
    }
    known = set(ids)
    for name, wanted in named.items():
        missing = sorted(wanted - known)
        if missing and known:
            shown = show(str(row[name])) if name != "robot" else show(robots)
            there_are = show(sorted(known), 80)[1:-1]
            reader.add(
                f"{place}.{name}",
                f"{shown}: there is no robot {' and no robot '.join(map(str, missing))}; ids are {there_are}",
            )
    if robots == ():
        reader.add(f"{place}.robot", "names no robot: leave robot out for all of them")
    given = [name for name in ("link", "robot", "partition") if row.get(name) is not None]
    if len(given) > 1:
        reader.add(place, f"gives {' and '.join(given)}: one of them says where")
    beyond = [name for name in (*SENSOR_FIELDS, *PROCESS_FIELDS) if row.get(name) is not None]
    if beyond and given and given[0] != "robot":
        reader.add(f"{place}.{given[0]}", f"{beyond[0]} is of robots: write robot = ... instead")
    if row.get("partition") is not None and row.get("topic", "hand") != "hand":
        reader.add(f"{place}.topic", 'a partition is between agents: leave topic out, or write "hand"')


def _check_when(row: Mapping[str, Any], place: str, reader: Reader) -> None:
    at, duration, every, until = (row.get(name) for name in ("at", "duration", "every", "until"))
    if every is not None:
        if duration is None:
            reader.add(f"{place}.every", 'needs a for, such as for = "500ms"')
        elif duration >= every:
            reader.add(f"{place}.for", f"{show(duration)} s is not shorter than every = {show(every)} s")
    elif until is not None:
        reader.add(f"{place}.until", "is the end of an every: write for = ... instead")
    if until is not None and until <= (at or 0.0):
        reader.add(f"{place}.until", f"{show(until)} s is not after the start at {show(at or 0.0)} s")
    ramps = [name for name in EFFECTS if isinstance(row.get(name), Effect) and row[name].end is not None]
    if ramps and duration is None:
        reader.add(
            f"{place}.{ramps[0]}", f'the ramp {show(str(row[ramps[0]]))} needs a for, such as for = "10s"'
        )
    timed = [name for name in CLOCK_FIELDS if row.get(name) is not None]
    if timed and any(value is not None for value in (at, duration, every, until)):
        reader.add(
            f"{place}.{timed[0]}",
            "holds for the whole run (a process reads the wall clock once): leave at, for and every out",
        )


def _check_actions(row: Mapping[str, Any], place: str, reader: Reader) -> None:
    at, duration = row.get("at"), row.get("duration")
    if row.get("wipe") and row.get("kill") is None and row.get("restart") is None:
        reader.add(f"{place}.wipe", "belongs to kill or restart: a process that lives keeps its disk")
    for name in ACTION_FIELDS:
        if row.get(name) is None:
            continue
        if at is None:
            reader.add(f"{place}.{name}", 'needs an at, such as at = "5s"')
        if name == "pause" and duration is None:
            reader.add(f"{place}.{name}", 'needs a for, such as for = "2s"')
        if name == "restart" and duration is not None:
            reader.add(
                f"{place}.for", "a restart is at once: to keep the process down for a while write kill"
            )


def _check_what(row: Mapping[str, Any], place: str, reader: Reader) -> None:
    link = [name for name in EFFECTS if row.get(name) is not None]
    own = [name for name in (*SENSOR_FIELDS, *PROCESS_FIELDS) if row.get(name) is not None]
    # What was given could not be read, or is no field any more.
    wrong = reader.is_recorded or any(bad.startswith(f"{place}.") for bad in reader.bad)
    if not link and not own and row.get("partition") is None and not wrong:
        reader.add(place, 'does nothing: give an effect, such as loss = "30%"')
    if own and row.get("link") is None and row.get("topic", "hand") != "hand" and not link:
        reader.add(f"{place}.topic", f"{own[0]} is not of messages: leave topic out")
    if own and row.get("robot") is None and any(name in ACTION_FIELDS for name in own):
        reader.add(f"{place}.{own[0]}", "needs a robot, such as robot = 3")
    if row.get("range") is not None and row.get("topic", "hand") in ("state", "wrench"):
        reader.add(f"{place}.range", "is between robots: a robot has no distance from its own plant")
