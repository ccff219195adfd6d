"""The command ``handfast new``: a commented fleet file to start from."""

from __future__ import annotations

import argparse
from pathlib import Path

from handfast.agent.common.errors import PASSED
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.data_files import TEMPLATE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast new`` takes."""
    parser.add_argument("name", metavar="NAME", help="the fleet's name; NAME.toml is written")
    parser.add_argument(
        "--lattice",
        metavar="N",
        type=int,
        help="N robots in a triangular lattice of 1 m, to study large fleets (default: three robots)",
    )
    parser.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    from handfast.agent.fleet.loading import parse_fleet

    path = Path(f"{options.name}.toml")
    text = _text(options)
    parse_fleet(text, source=str(path))  # a bad name is refused here, with the reason
    try:
        with open(path, "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path} exists already: name another fleet, or remove it") from None
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    print(f"wrote {path}; next: handfast check {path}")
    return PASSED


def _text(options: argparse.Namespace) -> str:
    if options.lattice is None:
        return TEMPLATE.read_text(encoding="utf-8").replace("@NAME@", options.name)
    from handfast.deploy.analysis.shapes import ROBOTS_MAX, ROBOTS_MIN, lattice

    if not ROBOTS_MIN <= options.lattice <= ROBOTS_MAX:
        raise InputError(f"--lattice: must be {ROBOTS_MIN} to {ROBOTS_MAX} robots, got {options.lattice}")
    return lattice(options.name, options.lattice)
