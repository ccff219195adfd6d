"""Hosts any `PlantBackend` on the bus as a process."""

from __future__ import annotations

import argparse
import socket
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from handfast.agent.common.time import Clock
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import Ticks, plant_slot_ns
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import Start, StartError, log_name, logger
from handfast.agent.runtime.process import main as process_main
from handfast.agent.transport.bus import BusError
from handfast.plant.backend import PlantBackend
from handfast.plant.node import PlantNode
from handfast.plant.pool import PlantPool, PoolTicks


def main(
    argv: Sequence[str] | None,
    program: str,
    make: Callable[[Fleet, int, Clock, Log], PlantBackend],
    beside: Sequence[int] = (),
    logs: Path | None = None,
    own: Sequence[argparse.ArgumentParser] = (),
) -> int:
    """Command line of a plant process. Returns the exit status.

    Args:
        argv: after the program's name; None: that of this process.
        program: its name, for messages.
        make: the backend of a robot, from its fleet, its id, the process's clock and what writes a line of
            its log.
        beside: robots whose plants the process serves, too. Others hear them through the fleet's routers:
            it listens nowhere.
        logs: folder of these plants' logs, each in a file of its own; None: in that of the process.
        own: have the program's own options, for its help.
    """

    def start(fleet: Fleet, robot: int, clock: Clock, log: Log) -> Start:
        if not fleet.is_resolved:  # else without numpy, which takes its time
            from handfast.agent.formation.geometry import resolved

            fleet = resolved(fleet)
        if beside:
            return _several(fleet, [robot, *beside], clock, log)
        backend = make(fleet, robot, clock, log)
        node = PlantNode(fleet, robot, backend)
        ticks_from = partial(Ticks, node, slot_ns=plant_slot_ns(fleet, robot))
        return Start(node, fleet.plant_listens(robot), [fleet.agent_near(robot)], ticks_from, backend.close)

    def _several(fleet: Fleet, robots: Sequence[int], clock: Clock, log: Log) -> Start:
        if not fleet.routers:
            raise StartError(
                "--with: the plants of several robots share a process only behind a router, and this file "
                "names none (network.routers)"
            )
        for robot in robots:
            fleet.robot(robot)  # says which are there
            if robots.count(robot) > 1:
                raise StartError(f"--with: robot {robot} is named twice")
        if logs is not None and not logs.is_dir():
            raise StartError(f"--logs: there is no folder {logs}")
        held = held_ports(fleet, robots)
        writing = [log, *(logger(f"robot {robot}", "plant", _log_of(robot)) for robot in robots[1:])]
        backends = [make(fleet, robot, clock, log) for robot, log in zip(robots, writing, strict=True)]
        nodes = [PlantNode(fleet, *each) for each in zip(robots, backends, strict=True)]
        pool = PlantPool(nodes, writing)

        def close() -> None:
            for backend in backends:
                backend.close()
            for port in held:
                port.close()

        agents = [fleet.agent_near(robot) for robot in robots]
        ticks_from = partial(PoolTicks, pool, slot_ns=plant_slot_ns(fleet, robots[0]))
        return Start(pool, (), agents, ticks_from, close, robots[1:])

    def _log_of(robot: int) -> Path | None:
        return None if logs is None else logs / log_name(robot, "plant")

    return process_main(argv, program, "plant", start, own)


def held_ports(fleet: Fleet, robots: Sequence[int]) -> list[socket.socket]:
    """Has the ports on which the plants of `robots` would listen in processes of their own, so that nobody
    starts a second body of one of them on this machine.

    Raises:
        BusError: somebody has one of them.
    """
    held: list[socket.socket] = []
    for robot in robots:
        for endpoint in fleet.plant_listens(robot):
            address, _, port = endpoint.partition("/")[2].rpartition(":")
            taken = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET)
            held.append(taken)
            taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # links of an earlier run may linger
            try:
                taken.bind((address.strip("[]"), int(port)))
                taken.listen(0)  # else others may listen there
            except OSError as error:
                for each in held:
                    each.close()
                raise BusError(
                    f"robot {robot}'s plant cannot have {endpoint}: {error.strerror}; is there one already?"
                ) from None
    return held
