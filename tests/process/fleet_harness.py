"""Agents and plants of a fleet as real processes, without `handfast run`, and an ear on their bus."""

from __future__ import annotations

import secrets
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

import tomli_w

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Message, Mission, PlantState, Status, Wrench
from handfast.agent.messages.validation import Malformed
from handfast.agent.transport.bus import Bus, Presence
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.processes.placement import Reservation
from tests.process.harness import ADDRESS, PATIENCE_S, Command, environment, last_lines, wait_for

BASE_PORT: Final = 21_120
"""Tests look for ports from here on: clear of the bundled fleets' own."""
MISSION_PERIOD_S: Final = 0.2
ROUTERS: Final = 2
ROUTER: Final = "router"
"""The role of a router's process, with its number in the place of a robot's."""
ROUTED: Final = 'network.topology="routed"'
"""The override that has a fleet's processes linked to routers."""
T = TypeVar("T")


def make_fleet(base: str = "pair", *overrides: str) -> Fleet:
    """A bundled fleet under a name of its own, resolved."""
    name = f"t-{secrets.token_hex(4)}"
    return resolved(load_fleet(FLEETS / f"{base}.toml", [f'fleet.name="{name}"', *overrides]))


@contextmanager
def placed(fleet: Fleet, address: str = ADDRESS) -> Iterator[Fleet]:
    """`fleet` on ports that no other test or run has, reserved while the context lasts; with `ROUTERS`
    routers where it is routed."""
    of_robots, of_routers = 2 * len(fleet.robots), ROUTERS if fleet.is_routed else 0
    ports = Reservation(ADDRESS, BASE_PORT, of_robots + of_routers)
    routers = tuple(f"{ADDRESS}:{ports.base + of_robots + k}" for k in range(of_routers))
    network = replace(fleet.network, address=address, base_port=ports.base, routers=routers)
    try:
        yield replace(fleet, network=network)
    finally:
        ports.close()


@dataclass(frozen=True)
class Heard:
    """One message off the bus and when it came, wall-clock ns."""

    at_ns: int
    key: str
    message: Message


class Robots:
    """Agents and plants of a fleet as processes, and an operator that listens and gives the mission once.

    Unlike `handfast run` it goes on when a process dies, and says nothing more once all drive. A context
    manager: leaving ends everything.

    Args:
        fleet: resolved and placed.
        folder: for the fleet file and the logs.
    """

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        self.fleet, self.folder = fleet, folder
        self.name = fleet.fleet.name
        self.heard: list[Heard] = []
        self.latest: dict[str, Message] = {}
        self.processes: dict[tuple[int, str], subprocess.Popen[bytes]] = {}
        self._all: list[subprocess.Popen[bytes]] = []
        self.mission: Mission | None = None
        """What `drive` gave; whoever starts again later has to be told by other robots."""
        self.members = tuple(robot for robot in fleet.ids if not fleet.robot(robot).reserve)
        self.fleet_file = folder / "fleet.toml"
        (folder / "logs").mkdir(parents=True)
        self.fleet_file.write_text(tomli_w.dumps(to_dict(fleet)))

    def __enter__(self) -> Robots:
        fleet = self.fleet
        endpoints = [
            endpoint
            for robot in fleet.ids
            for endpoint in (fleet.agent_endpoint(robot), fleet.plant_endpoint(robot))
        ]
        self.start_routers()
        routers = fleet.router_endpoints
        self.bus = Bus(
            listen=[], connect=() if routers else endpoints, routers=routers, go_on_waiting=lambda: True
        )
        for key in (key_expressions.mission(self.name), key_expressions.ask(self.name)):
            self.bus.declare(key)
        self.bus.subscribe(key_expressions.everything(self.name), 65_536)
        self.presence: Presence = self.bus.watch(key_expressions.alive(self.name, "*", "*"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._all:
            if process.poll() is None:
                process.kill()  # a frozen one too
        for process in self._all:
            process.wait()
        self.bus.close()

    # ---------------------------------------------------------------- processes

    def log(self, robot: int, role: str) -> Path:
        whose = f"router-{robot}" if role == ROUTER else f"robot-{robot}-{role}"
        return self.folder / "logs" / f"{whose}.log"

    def start(self, robot: int, role: str, *more: str) -> None:
        """Starts one process, which finds the orders that it kept; `more` are further arguments."""
        orders = ("--orders", str(self.folder / "orders"))
        self.run(
            robot,
            role,
            f"handfast.{role}",
            "--fleet",
            str(self.fleet_file),
            "--robot",
            str(robot),
            *orders,
            *more,
        )

    def run(self, robot: int, role: str, module: str, *arguments: str) -> None:
        """Starts one process; its last words are in `log(robot, role)`."""
        with open(self.log(robot, role), "ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, *arguments, "--exit-with-parent"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment(),
                start_new_session=True,
            )
        self.processes[robot, role] = process
        self._all.append(process)

    def start_routers(self) -> None:
        """Starts the routers, if the fleet has any."""
        for router in self.fleet.routers:
            self.start_router(router.number)

    def start_router(self, number: int) -> None:
        self.run(
            number,
            ROUTER,
            "handfast.agent.runtime.router",
            "--fleet",
            str(self.fleet_file),
            "--number",
            str(number),
        )

    def start_all(self) -> None:
        for robot in self.fleet.ids:
            for role in key_expressions.ROLES:
                self.start(robot, role)

    def signal(self, robot: int, role: str, number: int) -> int:
        """Sends a signal to one process; returns when, wall-clock ns."""
        now_ns = time.time_ns()
        self.processes[robot, role].send_signal(number)
        return now_ns

    def end(self, robot: int, role: str) -> int:
        """Asks one process to end and waits for it; returns its exit status."""
        process = self.processes[robot, role]
        process.terminate()
        return process.wait(PATIENCE_S)

    def died(self) -> list[str]:
        return [
            f"robot {robot}'s {role} ended with {process.returncode}"
            for (robot, role), process in self.processes.items()
            if process.poll() is not None
        ]

    def told(self) -> str:
        """What the processes said last, and what the bus did."""
        out = self.died()
        for robot, role in self.processes:
            out.append(f"--- robot {robot} {role}")
            out += last_lines(self.log(robot, role))
        out.append("--- bus")
        out += [f"{key}: {message}"[:300] for key, message in sorted(self.latest.items())]
        return "\n".join(out)

    # ---------------------------------------------------------------- bus

    def collect(self) -> None:
        """Takes what came."""
        now_ns = time.time_ns()
        for key, payload in self.bus.drain():
            try:
                message = decode(payload)
            except Malformed:
                continue
            self.heard.append(Heard(now_ns, key, message))
            self.latest[key] = message
        self.presence.update()

    def wait(self, look: Callable[[], T], what: str, timeout_s: float = PATIENCE_S) -> T:
        """`wait_for`, with the bus at work and the processes' last words on failure."""

        def collect_and_look() -> T:
            self.collect()
            return look()

        return wait_for(collect_and_look, what, timeout_s, self.told)

    def status(self, robot: int) -> Status | None:
        found = self.latest.get(key_expressions.status(self.name, robot))
        return found if isinstance(found, Status) else None

    def plant(self, robot: int) -> PlantState | None:
        found = self.latest.get(key_expressions.plant_state(self.name, robot))
        return found if isinstance(found, PlantState) else None

    def wrench(self, robot: int) -> Wrench | None:
        found = self.latest.get(key_expressions.wrench(self.name, robot))
        return found if isinstance(found, Wrench) else None

    def counters(self, robot: int) -> dict[str, int]:
        status = self.status(robot)
        return dict(status.counters) if status is not None else {}

    def states(self) -> dict[int, str]:
        """State of every robot whose agent has spoken."""
        return {
            robot: status.state
            for robot in self.fleet.ids
            if (status := self.status(robot)) is not None
        }  # fmt: skip

    def alive(self, robot: int, role: str) -> bool:
        return key_expressions.alive(self.name, robot, role) in self.presence.alive

    def wait_until_alive(self, robot: int, role: str, timeout_s: float = PATIENCE_S) -> None:
        self.wait(lambda: self.alive(robot, role), f"robot {robot}'s {role} alive", timeout_s)

    def are_all(self, state: str) -> bool:
        """Whether every member is in this state; who has no place stands by."""
        states = self.states()
        return len(states) == len(self.fleet.ids) and all(states[robot] == state for robot in self.members)

    def wait_until_all(self, state: str, timeout_s: float = PATIENCE_S) -> None:
        self.wait(lambda: self.are_all(state), f"every robot {state}", timeout_s)

    def since(self, from_ns: int, kind: type[Any], robot: int) -> Iterator[tuple[int, Any]]:
        """Messages of one class by one robot that were made after `from_ns`: (came at, message)."""
        for each in self.heard:
            if (
                type(each.message) is kind
                and each.message[0] == robot
                and each.message.time_ns > from_ns
                and each.at_ns > from_ns
            ):
                yield each.at_ns, each.message

    def first(
        self,
        from_ns: int,
        kind: type[Any],
        robot: int,
        which: Callable[[Any], bool],
        what: str,
        timeout_s: float = PATIENCE_S,
    ) -> tuple[float, Any]:
        """Waits for a message after `from_ns` that fits; returns how long after it came (s), and it."""

        def look() -> tuple[int, Any] | None:
            found = ((at, message) for at, message in self.since(from_ns, kind, robot) if which(message))
            return next(found, None)

        found = self.wait(look, what, timeout_s)
        assert found is not None
        return (found[0] - from_ns) / NS_PER_S, found[1]

    def drive(self, duration_s: float = 600.0, ahead_s: float = 0.3) -> int:
        """Gives the mission to a fleet that is ready, waits until it drives; returns its epoch, ns."""
        self.wait_until_all("ready")
        now_ns = time.time_ns()
        period_ns = self.fleet.period_ns
        epoch_ns = (now_ns + round(ahead_s * NS_PER_S)) // period_ns * period_ns
        mission = self.mission = self.mission_of(epoch_ns, duration_s)
        due_s = 0.0

        def say_and_look() -> bool:
            nonlocal due_s
            if time.monotonic() >= due_s:  # a link that is only just there may lose the first
                due_s = time.monotonic() + MISSION_PERIOD_S
                self.bus.publish(key_expressions.mission(self.name), encode(mission))
            return self.are_all("running")

        self.wait(say_and_look, "every robot running")
        return epoch_ns

    def publish_mission(self, mission: Mission) -> None:
        """Gives a mission once, as an operator."""
        self.bus.publish(key_expressions.mission(self.name), encode(mission))

    def mission_of(self, epoch_ns: int, duration_s: float) -> Mission:
        """The fleet file's mission, as an operator gives it now."""
        duration_ns = round(duration_s * NS_PER_S)
        return Mission(epoch_ns // 1_000, time.time_ns(), epoch_ns, duration_ns, digest(self.fleet))

    # ---------------------------------------------------------------- what must hold, by the stamps

    def drove_no_longer(self, robot: int, from_ns: int) -> None:
        """Fails the test when the plant of `robot`, whose agent is gone, drove on a wrench that was too old.

        By stamps: however late a process of a busy machine wakes, it must judge by its clock.
        """
        limit_ns = round(self.fleet.control.wrench_timeout_s * NS_PER_S) + 2 * self.fleet.period_ns
        last_ns = max(m.time_ns for m in self.said(Wrench, robot))
        drove = [m.time_ns for _, m in self.since(from_ns, PlantState, robot) if m.driving]
        assert all(at_ns <= last_ns + limit_ns for at_ns in drove), self.told()

    def asked_no_longer(self, robot: int, from_ns: int) -> None:
        """Likewise for its agent, whose plant is gone: it asks for nothing but to brake on an old state."""
        limit_ns = round(self.fleet.control.plant_timeout_s * NS_PER_S) + 2 * self.fleet.period_ns
        last_ns = max(m.time_ns for m in self.said(PlantState, robot))
        asked = [m.time_ns for _, m in self.since(from_ns, Wrench, robot) if not m.brake]
        assert all(at_ns <= last_ns + limit_ns for at_ns in asked), self.told()

    def said(self, kind: type[Any], robot: int) -> Iterator[Any]:
        """All messages of one class by one robot."""
        return (
            each.message
            for each in self.heard
            if type(each.message) is kind and each.message[0] == robot
        )  # fmt: skip

    def orders(self, kind: type[Any]) -> list[Any]:
        """All messages of one class that are no robot's own, such as stops."""
        return [each.message for each in self.heard if type(each.message) is kind]

    def versions(self) -> set[int]:
        """Versions of the mission that agents say they know."""
        return {
            status.mission_version
            for robot in self.fleet.ids
            if (status := self.status(robot)) is not None
        }  # fmt: skip

    # ---------------------------------------------------------------- commands for it

    def command(self, name: str, *arguments: str) -> Command:
        """`handfast NAME` for this fleet, as another process; it goes on, and is ended by leaving it."""
        words = name.split()
        folder = self.folder / f"{words[0]}-{secrets.token_hex(4)}"
        return Command(folder, *words, str(self.fleet_file), *arguments)

    def told_by(self, name: str, *arguments: str) -> tuple[int, str]:
        """The same to its end, with the bus at work: exit status and standard output."""
        with self.command(name, *arguments) as command:
            self.wait(lambda: command.process.poll() is not None, f"the end of handfast {name}")
            return command.wait(), command.out


@contextmanager
def all_ready(fleet: Fleet, folder: Path) -> Iterator[Robots]:
    """Every process of a fleet (resolved), on ports of its own, ready for a mission."""
    with placed(fleet) as here, Robots(here, folder) as all_robots:
        all_robots.start_all()
        all_robots.wait_until_all("ready")
        yield all_robots


@contextmanager
def robots(folder: Path, base: str = "pair", *overrides: str) -> Iterator[Robots]:
    """Every process of a bundled fleet, ready for a mission."""
    with all_ready(make_fleet(base, *overrides), folder) as all_robots:
        yield all_robots
