"""Hosts any `PlantBackend` on the bus as a process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from agent.fleet import Fleet
from agent.process import main as process_main
from plant.backend import PlantBackend
from plant.node import PlantNode


def main(argv: Sequence[str] | None, program: str, make: Callable[[Fleet, int], PlantBackend]) -> int:
    """Command line of a plant process; `make` builds the backend of a robot. Returns the exit status."""

    def start(fleet: Fleet, robot: int) -> tuple[PlantNode, Sequence[str], Sequence[str]]:
        node = PlantNode(fleet, robot, make(fleet, robot))
        return node, [fleet.plant_endpoint(robot)], [fleet.agent_endpoint(robot)]

    return process_main(argv, program, "plant", start)
