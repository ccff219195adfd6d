"""The command ``handfast replace``: a robot in reserve takes the place of another one."""

from __future__ import annotations

import argparse

from deploy.commands.running.orders import field, order_arguments, over, simple


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast replace`` takes."""
    order_arguments(parser, simple("replace"))
    field(parser, "robot", "N", "who goes", required=True)
    field(parser, "by", "N", "who takes its place", required=True)
    over(parser)
