"""The command ``handfast remove``: the body of a robot that is silent has been carried off the field."""

from __future__ import annotations

import argparse

from deploy.commands.running.orders import field, order_arguments, simple


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast remove`` takes."""
    order_arguments(parser, simple("remove"))
    text = "whose body is gone, repeatedly; the others keep away from it no more, until it is heard again"
    field(parser, "robots", "N", text, required=True, repeated=True)
