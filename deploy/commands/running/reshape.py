"""The command ``handfast reshape``: a running fleet takes up another formation or trajectory."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from agent.fleet.loading import fleet_tables, read_text
from deploy.commands.running.orders import field, give_order, given_fields, order_arguments, over
from deploy.console.arguments import InputError, fleet_path
from deploy.inventory.running import running_fleet
from deploy.orders.options import order_of_options, shape_tables

if TYPE_CHECKING:
    from agent.fleet.orders import OrderSection
    from agent.formation.mission_plan import Plan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast reshape`` takes."""
    order_arguments(parser, _reshape)
    field(parser, "scale", "S", "make the formation so many times as large")
    parser.add_argument(
        "--from",
        dest="source",
        metavar="FLEET",
        help="take up [formation] and [trajectory] of a fleet file or bundled fleet, as far as it has them",
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="A.B=V",
        help="new formation.offsets, .edges or .distance_m, or a new field of trajectory, repeatedly",
    )
    over(parser)


def _reshape(options: argparse.Namespace) -> int:
    given, file = given_fields(options), _tables(options.source)
    if not given.keys() - {"over_s"} and file is None and not options.overrides:
        raise InputError("reshape changes nothing: give --scale, --from or --set")
    fleet = running_fleet(options.fleet)

    def make(plan: Plan) -> OrderSection:
        tables = shape_tables(plan, options.overrides, file, str(options.source))
        return order_of_options("reshape", given, fleet.ids, tables)

    return give_order(fleet, make)


def _tables(source: str | None) -> Mapping[str, Any] | None:
    if source is None:
        return None
    path = fleet_path(source)
    return fleet_tables(read_text(path, "fleet file"), str(path))
