"""The command ``handfast rover-simulator``: an ArduPilot Rover, simulated, to try bridges with."""

from __future__ import annotations

from collections.abc import Sequence


def run(arguments: Sequence[str]) -> int:
    """Runs the command; the simulator reads its arguments by itself. Returns the exit status."""
    from handfast.bridges.mavlink.simulator.__main__ import main

    return main(arguments)
