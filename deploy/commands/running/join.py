"""The command ``handfast join``: a robot in reserve takes a place in the formation."""

from __future__ import annotations

import argparse

from deploy.commands.running.orders import field, order_arguments, over, simple


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast join`` takes."""
    order_arguments(parser, simple("join"))
    field(parser, "robot", "N", "who joins", required=True)
    field(parser, "edges", "N,N,...", "members with which it is to share an edge", required=True)
    field(parser, "distance_m", "D", "length of the new edges in m, or one for each")
    field(
        parser,
        "offset_m",
        "X,Y",
        "its place in the formation, m (--offset=-1,2); left out: found from its edges",
    )
    over(parser)
