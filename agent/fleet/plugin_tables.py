"""The plugins that a fleet file names, and the tables that they bring into it (PURE but for their import)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from typing import Any, Final

from agent.common import plugins
from agent.common.reader import Problem, Reader
from agent.common.settings import Entry, entries
from agent.fleet import plants
from agent.fleet.sections import Body, ControlSection, Robot, load_law

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


def complete(values: MutableMapping[str, Any], reader: Reader) -> None:
    """Gives every robot, and `control`, the table of the plugin that it uses, where the file has none."""
    rows = [(f"robot[{k}]", row, row["plant"]) for k, row in enumerate(values["robots"], 1)]
    control = values["control"]
    for holder, uses in ((Body, rows), (ControlSection, [("control", control, control["law"])])):
        for entry in reader.sections.get(holder, ()):
            for place, row, reference in uses:
                if reference is not None and _section_name(holder, reference) == entry.key:
                    reader.complete(entry, row, place)


def _section_name(holder: type, reference: str) -> str | None:
    if holder is Body and reference in plants.KINDS:
        return None
    plugin = (plants.load if holder is Body else load_law)(reference)
    return getattr(plugin, "section", None)


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
