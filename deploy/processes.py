"""The processes of one local run: all agents and plants of a fleet, and what a scenario does to them."""

from __future__ import annotations

from typing import Final

from agent.fleet import Fleet
from agent.hand import Pose
from agent.keys import ROLES
from deploy.children import Child, end_all
from deploy.process_faults import Action, Process
from deploy.runfolder import RunFolder

MODULES: Final = {"unicycle": "plant"}
"""Kind of plant -> module that hosts it."""


class Processes:
    """Every agent and plant of `fleet` (resolved and placed) as a child; logs go to the run's folder."""

    def __init__(self, fleet: Fleet, folder: RunFolder) -> None:
        self._fleet, self._folder = fleet, folder
        self._children: dict[Process, Child] = {}
        self._killed: set[Process] = set()
        self._dead: set[Process] = set()

    def start(self) -> None:
        for robot in self._fleet.ids:
            for role in ROLES:
                self._start(robot, role, None)

    def _start(self, robot: int, role: str, pose: Pose | None) -> None:
        module = "agent" if role == "agent" else MODULES[self._fleet.robot(robot).plant]
        # A simulated body that stands again, where it was.
        more = [] if pose is None else [f"--pose={pose.x!r},{pose.y!r},{pose.heading!r}"]
        log = self._folder.log(f"robot-{robot}-{role}.log")
        self._children[robot, role] = Child(robot, role, module, self._folder.fleet_file, log, more)

    @property
    def names(self) -> dict[Process, str]:
        """Every process's name, in the order of the start."""
        return {process: child.name for process, child in self._children.items()}

    def up(self, robot: int, role: str) -> bool:
        """Whether a process should run: it has neither been killed by a rule nor died."""
        return (robot, role) not in self._killed | self._dead

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
        elif action.what == "start":
            self._start(*process, pose if action.role == "plant" else None)
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
        for process, child in self._children.items():
            how = child.ended() if self.up(*process) else None
            if how is not None:
                self._dead.add(process)
                found.append((child, how))
        return found

    def end(self, timeout_s: float) -> list[Child]:
        """Ends all; returns those that had to be killed."""
        expected = self._killed | self._dead
        stubborn = end_all(self._children.values(), timeout_s)
        return [child for child in stubborn if (child.robot, child.role) not in expected]
