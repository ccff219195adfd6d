"""Runs made up for tests: fleets of any size whose robots move on known paths, and all their messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import cos, exp, pi, sin, sqrt

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import (
    ControlSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import HandState, Message, Mission, PlantState, Status, Wrench

EPOCH_NS = 1_763_600_000_000_000_000
Path = Callable[[float], tuple[float, float, float]]
"""Fleet time -> x, y, heading of the body."""
Sent = tuple[int, str, Message]
"""Received (ns), key, message."""


def triangle(rows: int) -> tuple[list[tuple[float, float]], list[tuple[int, int]]]:
    """Offsets of a triangular lattice of `rows` rows, tip at the lowest y, and its edges of 1 m."""
    offsets = [(c - r / 2, r * sqrt(3) / 2) for r in range(rows) for c in range(r + 1)]
    edges = [
        (i + 1, j + 1)
        for i, a in enumerate(offsets)
        for j, b in enumerate(offsets)
        if i < j and abs((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 - 1.0) < 1e-9
    ]
    return offsets, edges


def make_fleet(
    offsets: list[tuple[float, float]],
    edges: list[tuple[int, int]],
    *,
    name: str = "made-up",
    duration_s: float = 2.0,
    rate_hz: float = 50.0,
    hand_offset_m: float = 0.1,
    velocity: tuple[float, float] = (0.0, 0.0),
) -> Fleet:
    """A fleet whose robots are numbered from 1 in the order of `offsets`; r_s is 0.22 m."""
    return Fleet(
        FleetSection(name, rate_hz=rate_hz, duration_s=duration_s),
        FormationSection(tuple(edges), 0.22, offsets=tuple(offsets)),
        ControlSection(),
        TrajectorySection("line", velocity_mps=velocity),
        tuple(Robot(id=i + 1, x_m=x, y_m=y, hand_offset_m=hand_offset_m) for i, (x, y) in enumerate(offsets)),
    )


def messages(
    fleet: Fleet, paths: list[Path], *, truth: bool = False, state: str = "running", tick_us: int = 90
) -> Iterator[Sent]:
    """Every message of a run in which the body of robot k + 1 is at ``paths[k](t)``, from -0.2 s on.

    All are received 1 ms after they were sent. Statuses come every 0.2 s.
    """
    prefix, rate = fleet.fleet.name, fleet.fleet.rate_hz
    duration_ns = round(fleet.fleet.duration_s * 1e9)
    start_ns = EPOCH_NS - 500_000_000
    yield (
        start_ns,
        key_expressions.mission(prefix),
        Mission(1, start_ns, EPOCH_NS, duration_ns, "0123456789abcdef"),
    )
    per_status = max(1, round(0.2 * rate))
    for k in range(-per_status, round(fleet.fleet.duration_s * rate) + per_status):
        t = k / rate
        time_ns = EPOCH_NS + round(k * 1e9 / rate)
        received = time_ns + 1_000_000
        sequence = k + per_status
        for robot, path in zip(fleet.robots, paths, strict=True):
            x, y, heading = path(t)
            i, offset = robot.id, robot.hand_offset_m
            pose = PlantState(
                i, sequence, time_ns, x, y, heading, 0.1, 0.01 * i, 2.0, 0.1, True, True, True, ""
            )
            if truth:
                yield received, key_expressions.plant_truth(prefix, i), pose
                pose = pose._replace(x=x + 0.5, y=y - 0.5)
            yield received, key_expressions.plant_state(prefix, i), pose
            neighbours = tuple(sorted({*sum((e for e in fleet.formation.edges if i in e), ())} - {i}))
            hand_x, hand_y = x + offset * cos(heading), y + offset * sin(heading)
            force = exp(-max(t, 0.0) / 4)
            multipliers = tuple((j, 0.1 * j) for j in neighbours)
            heard = tuple((j, 500 + 100 * j) for j in neighbours)
            forces = (0.3 * force, 0.0, 0.0, (0.2 + 0.1 * i) * force, 0.0, 0.0, 0.0)
            hand = (len(neighbours), hand_x, hand_y, 0.1, 0.0, *forces, multipliers, heard)
            yield received, key_expressions.hand(prefix, i), HandState(i, sequence, time_ns, True, *hand)
            wrench = Wrench(i, sequence, time_ns, 10 * force * cos(i + t), force * sin(i + t), False)
            yield received, key_expressions.wrench(prefix, i), wrench
            if sequence % per_status == 0 and k >= 0:
                ages = tuple(1000 * (1 + j % 3) for j in neighbours)
                ticks = tuple(tick_us + n + i for n in range(per_status))
                n = sequence
                counters = (
                    ("sent", n), ("received", 2 * n), ("lost", i), ("delayed", 3), ("duplicated", 1),
                    ("corrupted", 0), ("rejected", 2), ("rejected.stale", 2), ("overruns", 1),
                )  # fmt: skip
                status = (
                    state,
                    "epoch",
                    "",
                    1,
                    0,
                    tuple((j, 2000, n, i, 10 * j, 250) for j in neighbours),
                    ticks,
                    ages * per_status,
                    counters,
                )
                yield received, key_expressions.status(prefix, i), Status(i, sequence, time_ns, *status)


def standing(x: float, y: float, heading: float = 0.0) -> Path:
    """A body that does not move."""
    return lambda t: (x, y, heading)


def in_formation(fleet: Fleet, mess_m: float = 0.0, calm_s: float = 3.0) -> list[Path]:
    """Bodies whose hand points follow the formation, off by up to `mess_m` m at first, dying away."""
    assert fleet.formation.offsets is not None
    velocity = fleet.trajectory.velocity_mps or (0.0, 0.0)

    def path(index: int, offset: tuple[float, float]) -> Path:
        turn, lever = index * 2.4, fleet.robots[index].hand_offset_m

        def at(t: float) -> tuple[float, float, float]:
            error = mess_m * exp(-max(t, 0.0) / calm_s)
            heading = 0.5 + 0.3 * sin(t / 2 + index)
            x = offset[0] + velocity[0] * t + error * cos(turn + t * error) - lever * cos(heading)
            y = offset[1] + velocity[1] * t + error * sin(turn + t * error) - lever * sin(heading)
            return x, y, heading % (2 * pi)

        return at

    return [path(index, offset) for index, offset in enumerate(fleet.formation.offsets)]


def payloads(sent: Iterator[Sent]) -> Iterator[tuple[int, str, bytes]]:
    """The same messages as they come off the bus."""
    for received_ns, key, message in sent:
        yield received_ns, key, encode(message)
