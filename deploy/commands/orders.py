"""The commands ``handfast join``, ``leave``, ``replace``, ``reshape``: change what a running fleet does."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from agent.fleet.loading import fleet_tables, read_text
from agent.fleet.model import Fleet
from deploy.console.arguments import InputError, fleet_path
from deploy.inventory.running import DONE, FAILED, MEANING, handled, running_fleet
from deploy.orders.options import OPTIONS, order_of_options, shape_tables

if TYPE_CHECKING:
    from agent.fleet.orders import OrderSection
    from agent.formation.mission_plan import Plan

EXIT: Final = (
    "All robots take it over at one time, a second from now, and come to it smoothly. Exit status: 0 all "
    "know; 1 some do not, or another operator was quicker; 2 bad input."
)


def add_parser(commands: Any) -> None:
    """Adds the commands to those of ``handfast``."""

    def add(name: str, text: str, command: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = commands.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}. {MEANING} {EXIT}"
        )
        sub.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
        sub.set_defaults(command=handled(command))
        return sub

    sub = add("join", "give a robot in reserve a place in a running fleet's formation", _simple("join"))
    _field(sub, "robot", "N", "who joins", required=True)
    _field(sub, "edges", "N,N,...", "members with which it is to share an edge", required=True)
    _field(sub, "distance_m", "D", "length of the new edges in m, or one for each")
    _field(
        sub,
        "offset_m",
        "X,Y",
        "its place in the formation, m (--offset=-1,2); left out: found from its edges",
    )
    _over(sub)
    sub = add("leave", "take a robot out of a running fleet's formation", _simple("leave"))
    _field(sub, "robot", "N", "who leaves; it brakes and stays where it is", required=True)
    _over(sub)
    sub = add("replace", "give a robot's place and edges to one in reserve", _simple("replace"))
    _field(sub, "robot", "N", "who goes", required=True)
    _field(sub, "by", "N", "who takes its place", required=True)
    _over(sub)
    sub = add("reshape", "give a running fleet another formation or trajectory", _reshape)
    _field(sub, "scale", "S", "make the formation so many times as large")
    sub.add_argument(
        "--from",
        dest="source",
        metavar="FILE",
        help="take up [formation] and [trajectory] of a fleet file or bundled fleet, as far as it has them",
    )
    sub.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="A.B=V",
        help="new formation.offsets, .edges or .distance_m, or a new field of trajectory, repeatedly",
    )
    _over(sub)


def _field(
    parser: argparse.ArgumentParser, key: str, metavar: str, text: str, *, required: bool = False
) -> None:
    parser.add_argument(OPTIONS[key], dest=f"order.{key}", metavar=metavar, help=text, required=required)


def _over(parser: argparse.ArgumentParser) -> None:
    _field(parser, "over_s", "TIME", "how long it may take; left out: as long as the limits of motion need")


def _given(options: argparse.Namespace) -> dict[str, str]:
    return {
        name.removeprefix("order."): value
        for name, value in vars(options).items()
        if name.startswith("order.") and value is not None
    }


def _simple(kind: str) -> Callable[[argparse.Namespace], int]:
    def command(options: argparse.Namespace) -> int:
        fleet = running_fleet(options.fleet)
        order = order_of_options(kind, _given(options), fleet.ids)
        return _order(fleet, lambda _: order)

    return command


def _reshape(options: argparse.Namespace) -> int:
    given, file = _given(options), _tables(options.source)
    if not given.keys() - {"over_s"} and file is None and not options.overrides:
        raise InputError("reshape changes nothing: give --scale, --from or --set")
    fleet = running_fleet(options.fleet)

    def make(plan: Plan) -> OrderSection:
        tables = shape_tables(plan, options.overrides, file, str(options.source))
        return order_of_options("reshape", given, fleet.ids, tables)

    return _order(fleet, make)


def _tables(source: str | None) -> Mapping[str, Any] | None:
    if source is None:
        return None
    path = fleet_path(source)
    return fleet_tables(read_text(path, "fleet file"), str(path))


def _order(fleet: Fleet, make: Callable[[Plan], OrderSection]) -> int:
    """Gives the order, and says what becomes of it."""
    from deploy.orders.mission_editing import OrderError
    from deploy.orders.mission_outcome import words
    from deploy.session.order import OrderSession
    from deploy.session.session import connected

    with connected(OrderSession(fleet)) as session:
        try:
            mission, ordering = session.order(make)
        except OrderError as error:
            raise InputError(f"cannot be done: {error}") from None
    if not ordering.overruled:
        print(words(mission))
    for line in ordering.outcomes():
        print(line)
    return DONE if ordering.done else FAILED
