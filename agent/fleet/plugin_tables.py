"""The plugins that a fleet file names, and the tables that they bring into it (PURE but for their import)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from handfast.agent.common import plugins
from handfast.agent.common.reader import Problem, Reader
from handfast.agent.common.settings import Entry, entries
from handfast.agent.fleet import plants
from handfast.agent.fleet.sections import LAWS, LAWS_GROUP, Body, ControlSection, Robot, load_law

NAMES_A_PLUGIN: Final = re.compile(
    r"\s*((robot_defaults|robot\s*\.[^.=]*)\s*\.\s*plant|control\s*\.\s*law)\s*="
)
"""What an override begins with that says which plugins there are."""


def read_plugins(raw: Mapping[str, Any], reader: Reader) -> list[Problem]:
    """Has `reader` know the tables of the plugins that the tables `raw` of a fleet file name.

    Returns what is wrong with plugins that cannot be used.
    """
    tables: dict[type, dict[str, Entry]] = {}
    problems, unread = [], set()
    done: set[str] = set()
    for place, reference, holder, load in _references(raw):
        if reference in done:
            continue
        done.add(reference)
        try:
            taken = entries(Robot if holder is Body else holder)
            entry = plugins.section(load(reference), reference, taken)
            first = entry and tables.setdefault(holder, {}).setdefault(entry.key, entry)
            if entry and first and first.hint is not entry.hint:
                raise plugins.PluginError(
                    f'{reference}: another plugin here has section = "{entry.key}" with other Settings'
                )
        except plugins.PluginError as error:
            problems.append(Problem(place, str(error)))
            unread.add(holder)
    reader.sections = {holder: tuple(held.values()) for holder, held in tables.items()}
    reader.unread = frozenset(unread)
    return problems


def plugins_named(raw: Mapping[str, Any]) -> frozenset[str]:
    """The plugins that the tables `raw` of a fleet file name; none of them is loaded."""
    return frozenset(reference for _, reference, *_ in _references(raw) if reference not in LAWS)


def complete(values: Mapping[str, Any], reader: Reader) -> None:
    """Writes plugins as ``package.module:Class``, and adds the tables of those that are used.

    `values` are valid.
    """
    robots = [(f"robot[{k}]", row, "plant", plants.GROUP) for k, row in enumerate(values["robots"], 1)]
    for place, row, field, group in [*robots, ("control", values["control"], "law", LAWS_GROUP)]:
        if row[field] is None or row[field] in plants.KINDS:
            continue
        row[field] = reference = plugins.resolve(row[field], group)
        load = load_law if group == LAWS_GROUP else plants.load
        name = getattr(load(reference), "section", None)
        for entry in (entry for held in reader.sections.values() for entry in held if entry.key == name):
            if entry.attribute in row:
                reader.complete(entry, row, place)


def _references(raw: Mapping[str, Any]) -> Iterator[tuple[str, str, type, Callable[[str], type[Any]]]]:
    """Place, reference, model of the table around it, and what loads it, of every plugin that is named."""
    rows = raw.get("robot")
    places: list[tuple[str, Any]] = [("robot_defaults", raw.get("robot_defaults"))]
    places += [(f"robot[{k}]", row) for k, row in enumerate(rows if isinstance(rows, list) else (), 1)]
    for place, table in places:
        reference = table.get("plant") if isinstance(table, Mapping) else None
        if isinstance(reference, str) and reference not in plants.KINDS:
            yield f"{place}.plant", reference, Body, plants.load
    control = raw.get("control")
    law = control.get("law") if isinstance(control, Mapping) else None
    if isinstance(law, str):
        yield "control.law", law, ControlSection, load_law
