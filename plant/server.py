"""Hosts any `PlantBackend` on the bus as a process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from agent.common.time import Clock
from agent.fleet.model import Fleet
from agent.runtime.loop import Log
from agent.runtime.process import Start
from agent.runtime.process import main as process_main
from plant.backend import PlantBackend
from plant.node import PlantNode


def main(
    argv: Sequence[str] | None, program: str, make: Callable[[Fleet, int, Clock, Log], PlantBackend]
) -> int:
    """Command line of a plant process. Returns the exit status.

    Args:
        argv: after the program's name; None: that of this process.
        program: its name, for messages.
        make: the backend of a robot, from its fleet, its id, the process's clock and what writes a line of
            its log.
    """

    def start(fleet: Fleet, robot: int, clock: Clock, log: Log) -> Start:
        if not fleet.is_resolved:  # else without numpy, which takes its time
            from agent.formation.geometry import resolved

            fleet = resolved(fleet)
        backend = make(fleet, robot, clock, log)
        node = PlantNode(fleet, robot, backend)
        return Start(node, fleet.plant_listens(robot), [fleet.agent_near(robot)], backend.close)

    return process_main(argv, program, "plant", start)
