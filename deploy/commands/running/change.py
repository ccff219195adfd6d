"""The command ``handfast change``: changes the formation or the trajectory of a running fleet."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.common.errors import FAILED, PASSED
from handfast.agent.fleet.orders import ORDER_FIELDS, OrderSection
from handfast.deploy.console.arguments import InputError, describe, fleet_path
from handfast.deploy.inventory.known_fleets import MEANING, handled, running_fleet
from handfast.deploy.orders.options import OPTIONS, order_of_options, shape_tables

if TYPE_CHECKING:
    from handfast.agent.formation.mission_plan import Plan

EXIT: Final = (
    "All robots start the change at the same time, a second from now. Exit status: 0 all robots have "
    "acknowledged it; 1 some have not, or another operator gave an order meanwhile; 2 bad input."
)
CHANGES: Final[Mapping[str, str]] = {
    "join": "give a robot in reserve a place in the formation",
    "leave": "take a robot out of the formation: it brakes and stays where it is",
    "replace": "give a robot's place and edges to one in reserve",
    "remove": "report that a silent robot has been carried off the field: the others no longer avoid it",
    "reshape": "give the fleet another formation or trajectory",
}
"""Kinds of orders that change a fleet, each with one line of help."""
_FIELDS: Final[Mapping[str, tuple[str, str]]] = {
    "robot": ("N", "the robot that joins, leaves or is replaced"),
    "by": ("N", "the robot that takes its place"),
    "robots": ("N", "the robot that is gone, repeatedly"),
    "edges": ("N,N,...", "members with which it is to share an edge"),
    "distance_m": ("D", "length of the new edges in m, or one for each"),
    "offset_m": ("X,Y", "its place in the formation, m (--offset=-1,2; default: found from its edges)"),
    "scale": ("S", "factor by which the formation grows"),
    "over_s": ("TIME", "duration of the change (default: as long as the limits of motion need)"),
}
"""Fields of an order that have an option, each with its metavar and help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``handfast change``."""
    describe(parser, f". {MEANING} {EXIT}")
    changes = parser.add_subparsers(title="changes", metavar="CHANGE", required=True)
    for kind, text in CHANGES.items():
        sub: argparse.ArgumentParser = changes.add_parser(kind, help=text, description=text)
        describe(sub, f". {MEANING} {EXIT}")
        sub.set_defaults(command=handled(_change), kind=kind, source=None, overrides=[])
        sub.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
        needed, _ = ORDER_FIELDS[kind]
        for key in [key for fields in ORDER_FIELDS[kind] for key in fields if key in _FIELDS]:
            metavar, meaning = _FIELDS[key]
            action = "append" if key == "robots" else "store"
            sub.add_argument(
                OPTIONS[key],
                dest=f"order.{key}",
                metavar=metavar,
                help=meaning,
                required=key in needed,
                action=action,
            )
    sub.add_argument(
        "--from",
        dest="source",
        metavar="FLEET",
        help="take [formation] and [trajectory] from this fleet file or bundled fleet",
    )
    sub.add_argument(
        "--set",
        dest="overrides",
        action="append",
        metavar="A.B=V",
        help="new formation.offsets, .edges or .distance_m, or a field of trajectory, repeatedly",
    )


def _change(options: argparse.Namespace) -> int:
    """Give the order, and print what becomes of it."""
    from handfast.deploy.orders.mission_editing import OrderError
    from handfast.deploy.orders.mission_outcome import words
    from handfast.deploy.session.order import OrderSession
    from handfast.deploy.session.session import connected

    given = {
        name.removeprefix("order."): ",".join(value) if isinstance(value, list) else value
        for name, value in vars(options).items()
        if name.startswith("order.") and value is not None
    }
    reshapes, file = options.kind == "reshape", _tables(options.source)
    if reshapes and not (given.keys() - {"over_s"} or file or options.overrides):
        raise InputError("reshape changes nothing: give --scale, --from or --set")
    fleet = running_fleet(options.fleet)
    order = None if reshapes else order_of_options(options.kind, given, fleet.ids)

    def make(plan: Plan) -> OrderSection:
        if order is not None:
            return order
        tables = shape_tables(plan, options.overrides, file, str(options.source))
        return order_of_options("reshape", given, fleet.ids, tables)

    with connected(OrderSession(fleet)) as session:
        try:
            mission, ordering = session.order(make)
        except OrderError as error:
            raise InputError(f"cannot be done: {error}") from None
    if not ordering.overruled:
        print(words(mission))
    for line in ordering.outcomes():
        print(line)
    return PASSED if ordering.done else FAILED


def _tables(source: str | None) -> Mapping[str, Any] | None:
    if source is None:
        return None
    from handfast.agent.fleet.loading import fleet_tables, read_text

    path = fleet_path(source)
    return fleet_tables(read_text(path, "fleet file"), str(path))
