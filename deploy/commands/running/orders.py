"""What the commands have in common that change what a running fleet does."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from agent.common.exit import FAILED, PASSED
from agent.fleet.model import Fleet
from deploy.console.arguments import InputError, describe
from deploy.inventory.running import MEANING, handled, running_fleet
from deploy.orders.options import OPTIONS, order_of_options

if TYPE_CHECKING:
    from agent.fleet.orders import OrderSection
    from agent.formation.mission_plan import Plan

EXIT: Final = (
    "All robots take it over at one time, a second from now, and come to it smoothly. Exit status: 0 all "
    "have acknowledged it; 1 some have not, or another operator ordered meanwhile; 2 bad input."
)


def order_arguments(parser: argparse.ArgumentParser, command: Callable[[argparse.Namespace], int]) -> None:
    """Begins the arguments of a command that gives an order: which fleet it is for, what it means."""
    describe(parser, f". {MEANING} {EXIT}")
    parser.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
    parser.set_defaults(command=handled(command))


def field(
    parser: argparse.ArgumentParser,
    key: str,
    metavar: str,
    text: str,
    *,
    required: bool = False,
    repeated: bool = False,
) -> None:
    """Adds the option for a field of an order; one that is `repeated` may be given many times."""
    parser.add_argument(
        OPTIONS[key],
        dest=f"order.{key}",
        metavar=metavar,
        help=text,
        required=required,
        action="append" if repeated else "store",
    )


def over(parser: argparse.ArgumentParser) -> None:
    """Adds the option for how long a change may take."""
    field(parser, "over_s", "TIME", "how long it may take; left out: as long as the limits of motion need")


def given_fields(options: argparse.Namespace) -> dict[str, str]:
    """The fields of the order that the options give, by name."""
    return {
        name.removeprefix("order."): ",".join(value) if isinstance(value, list) else value
        for name, value in vars(options).items()
        if name.startswith("order.") and value is not None
    }


def simple(kind: str) -> Callable[[argparse.Namespace], int]:
    """The command that gives an order of a kind, all of whose fields are options."""

    def command(options: argparse.Namespace) -> int:
        fleet = running_fleet(options.fleet)
        order = order_of_options(kind, given_fields(options), fleet.ids)
        return give_order(fleet, lambda _: order)

    return command


def give_order(fleet: Fleet, make: Callable[[Plan], OrderSection]) -> int:
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
    return PASSED if ordering.done else FAILED
