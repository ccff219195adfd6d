"""The processes of a fleet on this machine: agents, plants and simulated rovers, and what a scenario does
to them."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.runtime.order_store import order_file
from handfast.agent.runtime.process import log_name
from handfast.deploy.check.network import sharing
from handfast.deploy.console.wording import robots
from handfast.deploy.faults.process_actions import Action, Process
from handfast.deploy.processes.attributes import niceness
from handfast.deploy.processes.child import Child, end_all, name_of
from handfast.deploy.processes.forking import ForkServer
from handfast.deploy.processes.placement import Vehicle

VEHICLE: Final = "vehicle"
"""Role of a simulated rover. It is no process of the fleet's: it is not on the bus, and no rule names it."""
ROUTER: Final = "router"
"""Role of a router, whose number stands for a robot's."""
ROUTER_S: Final = 10.0
"""A router that does not listen by then is not waited for: its clients say what they miss."""
POLL_S: Final = 0.005


class Processes:
    """Processes of `fleet` (resolved and placed) as children.

    Args:
        fleet_file: what they read.
        log: from a name to the path of a log.
        vehicles: the fleet's simulated rovers.
        processes: which are wanted; all agents and plants unless given.
        look: bridges arm nothing: looking at a vehicle must not make it able to move.
        orders: folder in which operators' orders outlive them; None: nowhere.
        server: has them forked.
    """

    def __init__(
        self,
        fleet: Fleet,
        fleet_file: Path,
        log: Callable[[str], Path],
        vehicles: Sequence[Vehicle] = (),
        processes: Sequence[Process] | None = None,
        *,
        look: bool = False,
        orders: Path | None = None,
        server: ForkServer | None = None,
    ) -> None:
        self._fleet, self._fleet_file, self._log, self._vehicles = fleet, fleet_file, log, vehicles
        self._wanted = (
            [(robot, role) for robot in fleet.ids for role in ROLES] if processes is None else processes
        )
        self._look, self._orders, self._server = look, orders, server
        self._shares: dict[Process, Process] = {}
        """Under which process one is found that has none of its own."""
        for part in sharing(fleet) if processes is None else ():
            self._shares.update(((robot, "plant"), (part[0], "plant")) for robot in part)
        self.ours: Final = True
        self.begun_s = time.monotonic()
        self._children: dict[Process, Child] = {}
        self._killed: set[Process] = set()
        self._dead: set[Process] = set()
        self._has_begun = False

    def start(self) -> None:
        self.start_routers()
        for vehicle in self._vehicles:
            simulator = self._fleet.robot(vehicle.robot).kind.simulator
            self._run(vehicle.robot, VEHICLE, simulator, vehicle.arguments)
        for robot, role in self._wanted:
            if (robot, role) not in self._shares:
                self._start(robot, role, None)
        # They connect to their agents, which are there by now.
        for first in dict.fromkeys(self._shares.values()):
            self._start(*first, None)

    def start_routers(self) -> None:
        """Starts the fleet's routers, if it has any, and waits until they listen: a client is not to find
        nobody there. Meanwhile what forks the others loads what those need. Once."""
        if self._has_begun:
            return
        self._has_begun, self.begun_s = True, time.monotonic()
        fleet = self._fleet
        routers = [router.where for router in fleet.routers]
        for number in range(1, len(routers) + 1):
            arguments = ["--fleet", str(self._fleet_file), "--number", str(number)]
            log = self._log(f"router-{number}.log")
            self._children[number, ROUTER] = Child(
                number, ROUTER, "handfast.agent.runtime.router", arguments, log, name=f"router {number}"
            )
        if fleet.is_routed and self._server is not None:
            self._server.yields(niceness(len(fleet.robots)))
        # Plugins are the code of others: each process imports them for itself.
        has_plugins = fleet.control.law is not None or any(robot.kind.is_plugin for robot in fleet.robots)
        if self._server is not None and not has_plugins:
            self._server.preload(self._fleet_file)
        deadline_s = time.monotonic() + ROUTER_S
        for number, router in enumerate(routers, 1):
            while not _listens(router) and self._children[number, ROUTER].ended() is None:
                if time.monotonic() > deadline_s:
                    return
                time.sleep(POLL_S)

    def _start(self, robot: int, role: str, pose: Pose | None) -> None:
        kind = self._fleet.robot(robot).kind
        module = "handfast.agent" if role == "agent" else kind.program
        arguments = ["--fleet", str(self._fleet_file), "--robot", str(robot)]
        if self._orders is not None:
            arguments += ["--orders", str(self._orders)]
        if role == "plant" and not kind.vehicle and pose is not None:
            # A simulated body starts at rest where it was. A vehicle goes on by itself.
            arguments.append(f"--pose={pose.x!r},{pose.y!r},{pose.heading!r}")
        if role == "plant" and kind.vehicle and self._look:
            arguments.append("--look")
        name = ""
        process = robot, role
        if beside := [each for (each, _), first in self._shares.items() if first == process != (each, role)]:
            arguments += [
                f"--with={','.join(map(str, beside))}",
                f"--logs={self._log(log_name(*process)).parent.resolve()}",
            ]
            name = f"the plants of {robots([robot, *beside])}"
        self._run(robot, role, module, arguments, name)

    def _run(self, robot: int, role: str, module: str, arguments: Sequence[str], name: str = "") -> None:
        log = self._log(log_name(robot, role))
        self._children[robot, role] = Child(
            robot, role, module, arguments, log, self._server, name, for_many=bool(name)
        )

    @property
    def names(self) -> dict[Process, str]:
        """The name of every agent and plant that is on the bus, in the order of the file."""
        return {process: name_of(*process) for process in self._wanted}

    @property
    def says_sharing(self) -> str:
        """How many plants share how many processes, as part of a sentence; "" where none do."""
        processes = len(set(self._shares.values()))
        several = "es" * (processes != 1)
        return f", {len(self._shares)} of them in {processes} process{several}," if self._shares else ""

    @property
    def count(self) -> int:
        """How many processes they are."""
        return len(self._wanted) - len(self._shares) + len(set(self._shares.values()))

    def up(self, robot: int, role: str) -> bool:
        """Whether a process should run: it has neither been killed by a rule nor died."""
        process = robot, role
        return self._shares.get(process, process) not in self._killed | self._dead

    def look(self, present: Collection[Process], time_s: float | None) -> list[str]:
        """Nothing is to be said of tokens: how its children end is known better (`deploy.drive.drive`)."""
        return []

    def lacking(self, members: Collection[int]) -> list[str]:
        """Who is not there at the end: those whose end was planned, or has ended the run."""
        return []

    def carry_out(self, action: Action, pose: Pose | None) -> bool:
        """Does what a rule orders; False when the process has died of its own, and nothing was done.

        `pose`: where the robot's body was seen last; a simulated plant starts there again.
        """
        process = action.robot, action.role
        child = self._children[process]
        if process not in self._killed and child.ended() is not None:
            return False
        if action.what == "kill":
            child.kill()
            child.wait(10.0)  # the kernel's own work: its port is free after it
            self._killed.add(process)
            if action.wipe and self._orders is not None:
                order_file(self._orders, *process).unlink(missing_ok=True)
        elif action.what == "start":
            self._start(*process, pose)
            self._killed.discard(process)
        elif action.what == "stop":
            child.pause()
        else:
            child.resume()
        return True

    def resume_all(self) -> None:
        """Lets go on what rules have paused."""
        for child in self._children.values():
            child.resume()

    def deaths(self) -> list[tuple[Child, str]]:
        """Those that have ended since the last call without a rule's order, and how."""
        found = []
        expected = self._killed | self._dead
        for process, child in self._children.items():
            how = child.ended() if process not in expected else None
            if how is not None:
                self._dead.add(process)
                found.append((child, how))
        return found

    def end(self, timeout_s: float) -> list[Child]:
        """Ends all; returns those that had to be killed."""
        expected = self._killed | self._dead
        # Vehicles last: bridges may still have to stop them; and routers, by which a stop may still go.
        stubborn: list[Child] = []
        for roles in (ROLES, (VEHICLE, ROUTER)):
            stubborn += end_all([each for each in self._children.values() if each.role in roles], timeout_s)
        return [child for child in stubborn if (child.robot, child.role) not in expected]


def _listens(router: str) -> bool:
    """Whether somebody listens on an address and port of this machine."""
    address, _, port = router.rpartition(":")
    with suppress(OSError), socket.create_connection((address, int(port)), timeout=1.0):
        return True
    return False
