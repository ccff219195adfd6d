"""The command ``handfast leave``: a robot leaves the formation."""

from __future__ import annotations

import argparse

from deploy.commands.running.orders import field, order_arguments, over, simple


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast leave`` takes."""
    order_arguments(parser, simple("leave"))
    field(parser, "robot", "N", "who leaves; it brakes and stays where it is", required=True)
    over(parser)
