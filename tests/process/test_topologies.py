"""Fleets whose robots are linked to routers instead of to each other."""

from __future__ import annotations

import os
import re
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.batch import unpacked
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import PlantState, Status, Stop
from handfast.agent.transport.bus import Bus
from tests.process import attackers
from tests.process.fleet_harness import ROUTED, ROUTER, Robots, all_ready
from tests.process.harness import (
    BUSY,
    Command,
    children,
    last_lines,
    no_trouble_in_logs,
    running,
    wait_for,
)
from tests.process.same_way import assert_same_way
from tests.process.secured_fleet import TAKEN, SecuredRobots, secured_robots, three
from tests.process.small_fleets import triangle
from tests.process.test_run import AGREE_M, assert_complete

NETWORK = ("--set", "network.base_port=21700")
LARGE = ("avoidance.beacon_interval_max_s=1.6",)
"""The override that has beacons come in batches."""
DRIVE_S = 16.0
HELD_S = 2.0


def routed(folder: Path, fleet: str, *more: str) -> Command:
    arguments = ("run", fleet, "--out", str(folder / "out"), "--no-report", *NETWORK, *BUSY, *more)
    return Command(folder, *arguments)


def routers_of(command: Command) -> list[int]:
    return [
        pid for pid, text in children(command.process.pid).items() if "handfast.agent.runtime.router" in text
    ]


@pytest.mark.long
@pytest.mark.alone
def test_a_fleet_behind_two_routers_drives_as_it_does_in_virtual_time(tmp_path: Path) -> None:
    two = ("--set", 'network.routers=["10.0.0.1:7447", "10.0.0.2:7447"]', "--duration", f"{DRIVE_S:g}")
    with routed(tmp_path, "delta", *two) as command:
        told = command.wait_for_line(r"(?m)^starting 6 agents and 6 plants on ports .*, through (.*)$")
        assert re.fullmatch(r"2 routers on 127\.0\.0\.1:\d+", told[1]), told[1]
        command.wait_for_line("alive after")
        routers = routers_of(command)
        assert len(routers) == 2
        assert command.wait(DRIVE_S + 30.0) == 0, command.told()
    assert not [pid for pid in routers if running(pid)]
    assert "did not end" not in command.err, "it ends when asked"
    metrics = assert_complete(tmp_path / "out", report=False)
    messages = metrics["messages"]
    assert messages["received"] >= 0.98 * messages["sent"], messages
    log = last_lines(tmp_path / "out" / "logs" / "router-2.log")
    assert log[-1] == "router 2: ending (SIGTERM)", log
    arguments = ("simulate", "delta", "--duration", f"{DRIVE_S:g}", "--out", "out", "--no-report", *BUSY)
    with Command(tmp_path / "simulated", *arguments) as simulated:
        assert simulated.wait() == 0, simulated.told()
    assert_same_way(tmp_path / "out", tmp_path / "simulated" / "out", DRIVE_S, AGREE_M)


def test_a_router_that_dies_ends_the_run_and_no_robot_drives_on(tmp_path: Path) -> None:
    with routed(tmp_path, "pair", "--set", 'network.topology="routed"', "--duration", "60") as command:
        command.wait_until_driving()
        (router,) = routers_of(command)
        pids = list(command.children())
        assert len(pids) == 4
        os.kill(router, signal.SIGKILL)
        assert command.wait() == 1, command.told()
        wait_for(lambda: not any(map(running, pids)), "the end of all processes")
    assert re.search(r"Router 1 ended at \d+\.\d s \(killed by SIGKILL\)\.", command.err), command.told()


def dies(fleet: Robots, number: int) -> None:
    fleet.signal(number, ROUTER, signal.SIGKILL)
    fleet.processes[number, ROUTER].wait()


def back(fleet: Robots, number: int) -> None:
    log = fleet.log(number, ROUTER)
    before = log.read_text().count("router of")
    fleet.start_router(number)
    fleet.wait(lambda: log.read_text().count("router of") > before, f"router {number} listens")


def batched(fleet: Robots, for_s: float) -> set[int]:
    """Robots whose beacons come in batches meanwhile."""
    found: set[int] = set()
    with Bus(listen=[], connect=[], routers=fleet.fleet.router_endpoints) as bus:
        batches = key_expressions.beacon_batch(fleet.name)
        bus.subscribe(batches)
        until = time.monotonic() + for_s
        fleet.wait(lambda: time.monotonic() > until, "batches")
        keys = {robot: str(robot) for robot in fleet.fleet.ids}
        for _, payload in bus.drain():
            found |= {int(robot) for robot, _ in unpacked(payload, len(keys), keys)}
    return found


def drive_on(fleet: Robots) -> None:
    """Waits until each has said that it drives and hears all of its neighbours, from now on."""
    from_ns = time.time_ns()
    for robot in fleet.members:
        fleet.first(from_ns, Status, robot, lambda m: m.state == "running", f"robot {robot} drives")


@pytest.mark.long
@pytest.mark.parametrize("more", [(), LARGE], ids=["small", "large"])
def test_one_router_is_enough_and_without_any_all_hold(tmp_path: Path, more: tuple[str, ...]) -> None:
    slow = ("control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5", "fleet.rate_hz=25")
    with all_ready(triangle(ROUTED, *slow, *more), tmp_path / "r") as fleet:
        fleet.drive()
        assert bool(batched(fleet, 1.0)) is bool(more)
        begun_ns = time.time_ns()
        for first, second in ((1, 2), (2, 1)):
            dies(fleet, first)
            drive_on(fleet)
            back(fleet, first)
            dies(fleet, second)
            drive_on(fleet)
            back(fleet, second)
        assert not any(
            m.state == "fault" for robot in fleet.members for _, m in fleet.since(begun_ns, Status, robot)
        )
        for number in (1, 2):
            dies(fleet, number)
        # Nobody hears them; when one is back they say how they have stood.
        until = time.monotonic() + HELD_S
        fleet.wait(lambda: time.monotonic() > until, "they hold")
        from_ns = time.time_ns()
        fleet.start_router(2)
        drive_on(fleet)
        for robot in fleet.members:
            agent = fleet.log(robot, "agent").read_text()
            assert f"robot {robot} agent: holding" in agent, agent
            _, state = next(fleet.since(from_ns, PlantState, robot))
            assert abs(state.speed) < 0.3, "it begins to drive again from where it stood"
        no_trouble_in_logs(fleet.folder)


def test_nobody_gets_in_through_a_router_and_a_stop_gets_through(tmp_path: Path) -> None:
    """What a robot that was taken over says, the routers do not pass on; strangers have no link to them."""
    with secured_robots(three("fleet.rate_hz=25", ROUTED), tmp_path / "r") as fleet:
        fleet.drive()
        name, at = fleet.name, fleet.keys
        endpoints = fleet.fleet.router_endpoints
        begun_ns = time.time_ns()
        with ExitStack() as stack:
            slowly = stack.enter_context(attackers.sockets(endpoints))
            for who, (why, settings) in attackers.strangers(at).items():
                where = [each.replace("tls/", "tcp/") if who == "plain TCP" else each for each in endpoints]
                session = stack.enter_context(attackers.attacks(where, settings))
                attackers.say_as_others(session.put, fleet.fleet, at, fleet.ear.given)
                told(fleet, f"refused: a connection of somebody: {why}")
                assert not list(session.info.peers_zid()), who
                assert not list(session.info.routers_zid()), who
            settings = at.security(at.robot(TAKEN)).settings()
            robot_2 = stack.enter_context(attackers.attacks(endpoints[:1], settings, "client"))
            attackers.heard(robot_2, key_expressions.beacon(name, TAKEN))
            for _ in range(20):
                attackers.say_as_others(robot_2.put, fleet.fleet, at, fleet.ear.given)
                slowly()
            told(fleet, f"a message of {name}.robot.{TAKEN} that it may not send")
            fleet.collect()
            honest = [m for robot in fleet.members for _, m in fleet.since(begun_ns, Status, robot)]
            assert {m.state for m in honest} <= {"running", "degraded"}
            now_ns = time.time_ns()
            stop = Stop(now_ns // 1_000, now_ns, "a person on the field")
            fleet.bus.publish(key_expressions.stop(name), encode(stop))
            fleet.wait_until_all("stopped")
            for robot in fleet.members:
                assert fleet.status(robot).reason == "stop: a person on the field"  # type: ignore[union-attr]
        assert not fleet.died()
        no_trouble_in_logs(fleet.folder)


def told(fleet: SecuredRobots, text: str) -> None:
    """Waits until a router's log has it."""
    logs = [fleet.log(router.number, ROUTER) for router in fleet.fleet.routers]
    fleet.wait(lambda: any(text in log.read_text(errors="replace") for log in logs), text)
