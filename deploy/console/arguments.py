"""What commands have in common: which fleet is meant, with which changes, and how bad input is said."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Final

from handfast.agent.common.errors import Error
from handfast.agent.common.wording import did_you_mean, show
from handfast.agent.fleet.loading import add_scenario, fleet_tables, load_fleet, read_text
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import LAWS
from handfast.deploy.console.data_files import FLEETS, SCENARIOS, bundled
from handfast.deploy.console.wording import some


class InputError(Error):
    """Bad input; the text is one clear message."""


NAME_BYTES_MAX: Final = 255
PATH_MAX: Final = 4_000
"""Of a path, and of each part of it, as file systems have it."""
FIGURE_FORMATS: Final = ("png", "svg", "pdf")
"""Of a run's figures; the first one is always made."""


def fleet_path(name: str) -> Path:
    """The file that FLEET means: a path, or the name of a bundled fleet.

    Raises:
        InputError: it is neither.
    """
    return _path(name, FLEETS, "fleet")


def scenario_path(name: str) -> Path:
    """The file that SCENARIO means: a path, or the name of a bundled scenario.

    Raises:
        InputError: it is neither.
    """
    return _path(name, SCENARIOS, "scenario")


def refuse_long(name: str) -> None:
    """Refuses what is too long for any name of a file; raises `InputError`."""
    if any(len(os.fsencode(part)) > NAME_BYTES_MAX for part in Path(name).parts) or len(name) > PATH_MAX:
        raise InputError(f"{show(name)}: too long for the name of a fleet or file")


def _path(name: str, folder: Path, what: str) -> Path:
    refuse_long(name)
    path = Path(name)
    known = bundled(folder)
    if path.is_dir():  # one that is named like a bundled fleet, as a run's may be, must not hide it
        if name in known:
            return folder / f"{name}.toml"
        inside = path / f"{what}.toml"
        instead = f": give {inside}" if inside.is_file() else ""
        raise InputError(f"{name} is a folder, not a {what} file{instead}")
    if path.exists() or path.suffix == ".toml" or len(path.parts) > 1:
        return path
    if name in known:
        return folder / f"{name}.toml"
    hint = did_you_mean(name, known) or f"there are: {', '.join(known)}"
    raise InputError(f"{name}: no such file, and no bundled {what} of that name; {hint}")


def describe(parser: argparse.ArgumentParser, more: str) -> None:
    """Adds to a command's description, which begins with its line in the table of commands."""
    text = parser.description or " "
    parser.description = f"{text[0].upper()}{text[1:]}{more}"


def fleet_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds FLEET and the options that change it."""
    parser.add_argument("fleet", metavar="FLEET", help="fleet file, or name of a bundled fleet")
    change_arguments(parser)
    parser.add_argument("--orders", metavar="FILE", help="add the [[order]] tables of a file")


def change_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options that change a fleet."""
    parser.add_argument(
        "--law",
        metavar="LAW",
        help=f"preset of the control law: {', '.join(LAWS)}; or a plugin: package.module:Class, or its name",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="A.B=V",
        help="override any field, repeatedly",
    )
    parser.add_argument(
        "--faults",
        metavar="SCENARIO",
        help=f"add the faults of a file, or of a bundled scenario: {', '.join(bundled(SCENARIOS))}",
    )
    parser.add_argument("--duration", metavar="TIME", help="short for --set fleet.duration_s=TIME")
    parser.add_argument("--seed", metavar="N", help="short for --set fleet.seed=N")


def place_for(text: str) -> str:
    """The value of an option that says where something goes.

    Raises:
        argparse.ArgumentTypeError: it is empty, as where a shell's variable was not set.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty: name a folder, or leave the option out")
    return text


def drive_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of every command that drives a fleet: folder, report, check, quiet."""
    parser.add_argument(
        "--out",
        type=place_for,
        metavar="DIR",
        help="the run's folder (default: runs/FLEET-TIME); must be empty or new",
    )
    report_arguments(parser)
    parser.add_argument(
        "--no-check",
        dest="check",
        action="store_false",
        help="drive even where `check` finds errors (and `run` more robots than this machine carries)",
    )
    parser.add_argument("--quiet", action="store_true", help="say only what went wrong and the verdict")


def view_argument(parser: argparse.ArgumentParser) -> None:
    """Adds ``--view``."""
    parser.add_argument(
        "--view",
        action="store_true",
        help="show the fleet in the browser while it drives, and then its recording, until Ctrl-C",
    )


def report_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what is made of a drive at its end: ``--no-report`` or ``--figures``."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--no-report", dest="report", action="store_false", help="no figures, no report.html")
    figures_argument(either)


def figures_argument(parser: argparse._ActionsContainer) -> None:
    """Adds ``--figures FORMATS``, as `options.figures`: a tuple of `FIGURE_FORMATS`."""
    parser.add_argument(
        "--figures",
        type=figure_formats,
        default=(),
        metavar="svg|pdf",
        help="write figures in this format too, beside the PNGs; several: svg,pdf",
    )


def figure_formats(text: str) -> tuple[str, ...]:
    """The formats in the value of ``--figures``, each once.

    Raises:
        argparse.ArgumentTypeError: one is none of `FIGURE_FORMATS`.
    """
    formats = tuple(dict.fromkeys(each.strip().lower() for each in text.split(",")))
    for each in formats:
        if each not in FIGURE_FORMATS:
            known = ", ".join(FIGURE_FORMATS)
            raise argparse.ArgumentTypeError(f"{show(each)}: no format of figures; there are: {known}")
    return formats


def host_argument(parser: argparse.ArgumentParser) -> None:
    """Adds ``--host NAME``, which may be given many times, as `options.hosts`."""
    parser.add_argument(
        "--host",
        dest="hosts",
        action="append",
        default=[],
        metavar="NAME",
        help="only this one, repeatedly (default: all)",
    )


def refuse_hosts(fleet: Fleet, options: argparse.Namespace) -> None:
    """`InputError` where ``--host`` is given for a fleet that runs on this machine."""
    if options.hosts:
        raise InputError(f"--host: {fleet.fleet.name} runs on this machine, and has no hosts: leave it out")


def no_changes() -> dict[str, object]:
    """What `load` needs of a command without options that change a fleet."""
    return {"overrides": [], "law": None, "faults": None, "duration": None, "seed": None, "orders": None}


def overrides(options: argparse.Namespace) -> list[str]:
    """All ``table.field=value`` that the options give."""
    given = list(options.overrides)
    if options.duration is not None:
        given.append(f"fleet.duration_s={options.duration}")
    if options.seed is not None:
        given.append(f"fleet.seed={options.seed}")
    return given


def load(options: argparse.Namespace) -> Fleet:
    """The fleet as the options have it, resolved: offsets, edges and distances written out.

    Raises:
        InputError, handfast.agent.fleet.model.FleetError: it cannot be.
    """
    from handfast.agent.formation.geometry import resolved

    return resolved(load_unresolved(options))


def load_unresolved(options: argparse.Namespace) -> Fleet:
    """The fleet as the options have it; raises as `load`."""
    scenario = scenario_path(options.faults) if options.faults is not None else None
    return load_fleet(fleet_path(options.fleet), overrides(options), options.law, scenario, options.orders)


def fleet_text(path: Path, scenario: Path | None = None) -> str:
    """The text of a fleet file, with the faults of a scenario in it if one is given.

    Raises:
        handfast.agent.fleet.model.FleetError: one of them cannot be read, or is not valid.
    """
    text = read_text(path, "fleet file")
    if scenario is None:
        return text
    import tomli_w  # here: only this needs it

    tables = fleet_tables(text, str(path))
    add_scenario(tables, read_text(scenario, "scenario"), str(scenario))
    return tomli_w.dumps(tables)


def robots_argument(parser: argparse.ArgumentParser) -> None:
    """Adds ``--robot N``, which may be given many times, as `options.robots`."""
    parser.add_argument(
        "--robot",
        dest="robots",
        type=int,
        action="append",
        default=[],
        metavar="N",
        help="only this one, repeatedly (default: all)",
    )


def robots_named(fleet: Fleet, options: argparse.Namespace) -> tuple[int, ...]:
    """The robots that the options name, ascending; () for all.

    Raises:
        InputError: there is no such robot.
    """
    strangers = sorted(set(options.robots) - set(fleet.ids))
    if strangers:
        raise InputError(
            f"there is no robot {some(strangers)} in {fleet.fleet.name}; there are: {some(fleet.ids)}"
        )
    return tuple(sorted(set(options.robots)))
