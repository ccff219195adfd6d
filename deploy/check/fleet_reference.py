"""Writes ``docs/fleet-file.md`` from the models of the fleet file, so that it says what they say.

``python -m handfast.deploy.check.fleet_reference`` prints the page; with ``--check`` it compares the page in
docs with it (exit status 1 when they differ).
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, Final, Literal, get_args, get_origin

from handfast.agent.common.quantities import UNITS
from handfast.agent.common.settings import Entry, entries
from handfast.agent.common.wording import example, show
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import LAWS, TRAJECTORY_FIELDS
from handfast.deploy.console.data_files import ROOT, TEMPLATE

PAGE: Final = ROOT / "docs" / "fleet-file.md"
WIDTH: Final = 110  # of the page's lines, but for the example, which is a file

_HEAD: Final = """\
# The fleet file

<!-- Made of the tables in agent/fleet/: change them there, then
     python -m handfast.deploy.check.fleet_reference > docs/fleet-file.md -->

One TOML file describes a fleet: who drives where, what it weighs, which law it obeys. Every process reads the
same file. `handfast new NAME` writes one to start from, `handfast check FLEET` says what is wrong with one
and what it will do. All problems are listed at once, each with its place; positions in arrays are counted
from 1, so `robot[1]` is the first `[[robot]]`.

Lengths are in m, times in s, angles in rad. x points east, y north; headings turn counter-clockwise from
east. Unknown tables and fields are errors. A required field must be given; a table without required fields
may be left out.

A field's line reads: name = default, or *required*; in brackets what it takes, with its unit and bounds; what
it means; an example, where the default is none.
"""

_SET: Final = """\
## On the command line

`--set TABLE.FIELD=VALUE` overrides any field for one run, and may be given many times; `--law NAME` presets
part of `[control]`. `--set` wins over `--law`, and `--law` over the file. The value is read as TOML; what is
not TOML is taken as a string, so that quotes can be left out.

    handfast run delta --set fleet.rate_hz=20 --set control.coupling=edge
    handfast run delta --set robot.3.mass_kg=12            # the robot with id 3
    handfast run delta --set robot_defaults.mass_kg=12     # all that do not say it themselves
    handfast run delta --set trajectory.kind=hold          # the file's velocity is then left out too
    handfast run delta --set 'formation.edges=[[1, 2], [2, 3]]'
    handfast run delta --set control.plant_timeout_s=200ms
    handfast run rovers --set robot.3.mavlink.connection=udpin:0.0.0.0:14553
"""


def render() -> str:
    """The whole page, Markdown."""
    parts = [_HEAD, _example(), *_tables(), _kinds(), _units(), _SET, _laws()]
    return "\n".join(parts)


def _example() -> str:
    template = TEMPLATE.read_text(encoding="utf-8").replace("@NAME@", "triangle")
    return f"## An example\n\n```toml\n{template}```\n"


def _tables() -> Iterator[str]:
    shown: dict[type, str] = {}
    for entry in entries(Fleet).values():
        model = entry.table or entry.tables
        assert model is not None, f"{entry.key} is not a table: this page has no place for it"
        yield from _section(entry, entry.key, shown)


def _section(entry: Entry, name: str, shown: dict[type, str], above: type | None = None) -> Iterator[str]:
    """One table of fields, and the tables within it. Fields that `above` has too are left out.

    Args:
        shown: the title of each kind of table so far.
    """
    model = entry.table or entry.tables
    assert model is not None
    title = _title(entry, name)
    like = next(
        (above for other, above in shown.items() if entries(model).keys() <= entries(other).keys()), ""
    )
    if like:
        text = f"{entry.setting.doc} Its fields are those of `{like}`."
        yield f"## `{title}`\n\n{_wrapped(text)}\n"
        return
    title = shown[model] = _title(entry, name)
    others = entry.setting.shared[1] if entry.setting.shared else above
    known = {field.key: field.setting.doc for field in entries(others).values()} if others else {}
    own = [
        field
        for field in entries(model).values()
        if known.get(field.key) != field.setting.doc and field.key != entry.setting.named
    ]
    fields = [_item(_field(field)) for field in own if not (field.table or field.tables)]
    yield f"## `{title}`\n\n{_wrapped(entry.setting.doc)}\n\n" + "\n".join(fields) + "\n"
    for field in own:
        if field.table or field.tables:
            yield from _section(field, f"{name}.{field.key}", shown, model)


def _title(entry: Entry, name: str) -> str:
    if entry.setting.named is not None:
        return f"[{name}.NAME]"
    return f"[[{name}]]" if entry.tables else f"[{name}]"


def _field(field: Entry) -> str:
    """All that is said of one field."""
    kind = "string" if field.setting.parse else _type(field.hint, field.setting.unit)
    bounds = field.setting.range_text() or field.setting.pattern_says
    takes = kind + (f", {bounds}" if bounds else "")
    given = example(field.hint, field.setting, field.default)
    default = None if field.required or field.default is None else show(field.default)
    if field.required:
        name = f"`{field.key}`, *required*"
    elif default is None:
        name = f"`{field.key}`"
    else:
        name = f"`{field.key} = {default}`"
    shown = "" if given == default else f" Example: `{given}`"
    return f"{name} ({takes}): {field.setting.doc}{shown}"


def _item(text: str) -> str:
    return _wrapped(text, "- ", "  ")


def _wrapped(text: str, first: str = "", rest: str = "") -> str:
    """Lines of at most `WIDTH`; what is in backquotes stays on one line."""
    whole = re.sub(r"`[^`]+`", lambda match: match.group().replace(" ", "\0"), text)
    lines = textwrap.wrap(
        whole,
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(lines).replace("\0", " ")


def _type(hint: Any, unit: str | None) -> str:
    if get_origin(hint) is Literal:
        return ", ".join(f"`{show(arg)}`" for arg in get_args(hint))
    return _words(hint) + (f" [{unit}]" if unit else "")


def _words(hint: Any, plural: str = "") -> str:
    args = get_args(hint)
    if get_origin(hint) is tuple:
        if args[-1] is Ellipsis:
            return f"array{plural} of {_words(args[0], 's')}"
        assert len(args) == 2, f"no word for {hint}"
        return f"pair{plural} of {_words(args[0], 's')}"
    if args:
        return " or ".join(_words(arg) for arg in args)
    return {float: "number", int: "whole number", bool: "`true` or `false`", str: "string"}[hint] + plural


def _kinds() -> str:
    lines = ["## Kinds of trajectory\n", "| `kind` | needs | takes besides |\n|---|---|---|"]
    for kind, (needed, taken) in TRAJECTORY_FIELDS.items():
        cells = (", ".join(f"`{key}`" for key in keys) for keys in (needed, taken))
        lines.append(f"| `{show(kind)}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _units() -> str:
    lines = [
        "## Units in strings\n",
        "A number of one of these units may also be a string with a unit; other units take plain numbers.\n",
        "| unit of the field | suffixes | example |\n|---|---|---|",
    ]
    used = set(_units_of(Fleet))
    for name, unit in UNITS.items():
        if name in used:
            suffixes = ", ".join(f"`{suffix}`" for suffix in unit.suffixes)
            lines.append(f"| {name} | {suffixes} | `{show(unit.example)}` |")
    return "\n".join(lines) + "\n"


def _units_of(model: type) -> Iterator[str | None]:
    for field in entries(model).values():
        inside = field.table or field.tables
        if inside is not None:
            yield from _units_of(inside)
        yield field.setting.unit


def _laws() -> str:
    return (
        "\n".join(
            _item(f"`--law {name}`: {', '.join(f'`{key} = {show(value)}`' for key, value in preset.items())}")
            for name, preset in LAWS.items()
        )
        + "\n"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints the page, or checks the one in docs; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        sys.stdout.write(render())
        return 0
    if list(arguments) != ["--check"]:
        print("usage: python -m handfast.deploy.check.fleet_reference [--check]", file=sys.stderr)
        return 2
    if PAGE.is_file() and PAGE.read_text(encoding="utf-8") == render():
        return 0
    print(
        f"{PAGE} is out of date: python -m handfast.deploy.check.fleet_reference > docs/fleet-file.md",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
