"""How soon robots react: to an agent or a plant that is killed, and to `handfast stop`.

The six robots of `delta` drive as twelve processes; in every round one agent is killed, one plant, and the
fleet is stopped, each when all drive, and all drive on before the next. A time counts to the moment at which
an observer on the bus has the message that shows the reaction, so the way of that message is part of it.
"""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Ask, PlantState, Status, Stop, Wrench
from tests.benchmarks.figures import Figure, Options, Result, spread
from tests.benchmarks.processes import BenchmarkError
from tests.process.fleet_harness import Robots, robots

ROUNDS: Final = 10
QUICK_ROUNDS: Final = 3
KILLED_S: Final = 0.3
STOPPED_S: Final = 0.2
FAST_MPS: Final = 0.1


def agent_killed(fleet: Robots, robot: int) -> float:
    """Seconds from SIGKILL of an agent to its plant braking."""
    moves(fleet, robot)
    killed_ns = fleet.signal(robot, "agent", signal.SIGKILL)
    took, _ = fleet.first(killed_ns, PlantState, robot, lambda m: not m.driving, "its plant brakes")
    fleet.processes[robot, "agent"].wait()
    fleet.start(robot, "agent")
    return took


def plant_killed(fleet: Robots, robot: int) -> float:
    """Seconds from SIGKILL of a plant to its agent's fault."""
    moves(fleet, robot)
    killed_ns = fleet.signal(robot, "plant", signal.SIGKILL)
    took, _ = fleet.first(killed_ns, Status, robot, lambda m: m.state == "fault", "its agent says fault")
    fleet.processes[robot, "plant"].wait()
    state = fleet.plant(robot)
    assert state is not None
    fleet.start(robot, "plant", f"--pose={state.x!r},{state.y!r},{state.heading!r}")
    return took


def stopped(fleet: Robots) -> tuple[float, float]:
    """Seconds to the last robot whose wrench brakes: since the stop was sent, and since the command began."""
    for robot in fleet.members:
        moves(fleet, robot)
    begun_ns = time.time_ns()
    status, out = fleet.told_by("stop")
    if status:
        raise BenchmarkError(f"handfast stop failed: {out}")
    # What an operator sends goes to the robots only: they tell when it was.
    fleet.bus.publish(key_expressions.ask(fleet.name), encode(Ask(time.time_ns(), "benchmark")))
    sent: Stop = fleet.wait(lambda: [m for m in fleet.orders(Stop) if m.time_ns > begun_ns], "the stop")[-1]
    came_ns = [
        first(fleet, Wrench, robot, lambda m: m.brake and m.time_ns >= begun_ns) for robot in fleet.members
    ]
    drove = [
        at_ns
        for robot in fleet.members
        for at_ns, m in fleet.since(max(came_ns), Wrench, robot)
        if not m.brake
    ]
    if drove:
        raise BenchmarkError(f"robots drove on {(max(drove) - sent.time_ns) / NS_PER_S:.2f} s after a stop")
    status, out = fleet.told_by("resume")
    if status:
        raise BenchmarkError(f"handfast resume failed: {out}")
    return (max(came_ns) - sent.time_ns) / NS_PER_S, (max(came_ns) - begun_ns) / NS_PER_S


def first(fleet: Robots, kind: type[Any], robot: int, which: Callable[[Any], bool]) -> int:
    """When the first message of a robot that fits came, of those that are kept."""
    for each in fleet.heard:
        if type(each.message) is kind and each.message[0] == robot and which(each.message):
            return each.at_ns
    raise BenchmarkError(f"robot {robot} said nothing of the kind")


def moves(fleet: Robots, robot: int) -> None:
    fleet.wait(
        lambda: (state := fleet.plant(robot)) and state.driving and abs(state.speed) > FAST_MPS,
        f"robot {robot} moves",
    )


def run(options: Options) -> Result:
    rounds = QUICK_ROUNDS if options.quick else ROUNDS
    agents: list[float] = []
    plants: list[float] = []
    stops: list[float] = []
    commands: list[float] = []
    with (
        tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder,
        robots(Path(folder) / "robots", "delta") as fleet,
    ):
        fleet.drive()
        ids = fleet.members

        def again() -> None:
            """All drive by the law; what was heard is not needed any more."""
            fleet.wait_until_all("running", 30.0)
            fleet.heard.clear()

        for number in range(rounds):
            again()
            agents.append(agent_killed(fleet, ids[number % len(ids)]))
            again()
            plants.append(plant_killed(fleet, ids[-1 - number % len(ids)]))
            again()
            sent, whole = stopped(fleet)
            stops.append(sent)
            commands.append(whole)
    whole_command = Figure(
        "handfast stop, started, to all wrenches braking", median(commands), "s", note=spread(commands)
    )
    return Result(
        [
            *figures("SIGKILL of an agent to its plant braking", agents, KILLED_S),
            *figures("SIGKILL of a plant to its agent's fault", plants, KILLED_S),
            *figures("handfast stop, sent, to all wrenches braking", stops, STOPPED_S),
            whole_command,
        ],
        [f"{rounds} rounds, {len(ids)} robots, {2 * len(ids)} processes"],
    )


def figures(what: str, took: Sequence[float], limit: float) -> list[Figure]:
    return [
        Figure(f"{what}, worst", max(took), "s", limit, note=spread(took)),
        Figure(f"{what}, median", median(took), "s"),
    ]
