"""Step responses of the hand point: a rover behind the bridge's control parts against the ideal body.

The agent believes that it drives a double integrator. Here it gets the ideal unicycle, and then a rover with
the measured delays and lags (`bridges.mavlink.ardupilot.dynamics`), measured at 25 Hz and seen 50 to 65 ms
late, behind `bridges.mavlink.bridge.estimate` and `bridges.mavlink.bridge.setpoint`: without and with the
lead, and with the hand's velocity from the measured speeds, from the reference, or from it within a little
of the measured ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import count
from math import hypot, inf, sqrt
from typing import Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.control import hand
from agent.control.hand import Pose
from bridges.mavlink.ardupilot.dynamics import RoverDynamics
from bridges.mavlink.bridge.estimate import Estimate
from bridges.mavlink.bridge.setpoint import LEAD_SPEED_S, LEAD_YAW_S, REPORT_DEAD_BAND, Bounds, Setpoint
from plant.backend import Command
from plant.unicycle import Actuator, integrate
from tests.benchmarks.figures import Figure, Options, Result, table

MASS: Final = 10.0
INERTIA: Final = 1.0
REACH: Final = 0.4
RATE_HZ: Final = 25
PERIOD_NS: Final = NS_PER_S // RATE_HZ
DT: Final = 1.0 / RATE_HZ
STEP_NS: Final = 5_000_000
"""The rover moves in such steps, as its autopilot is busy between ticks."""
AGES_NS: Final = (50_000_000, 65_000_000, 55_000_000, 60_000_000)
"""From the stamp of a sample to when it has come, by turns."""
C1: Final = 0.4
C2: Final = 0.6
ACCELERATION: Final = 0.5
STEP_M: Final = 0.3
CRUISE: Final = 0.34

Pair = tuple[float, float]
Law = Callable[[float, hand.Hand], tuple[float, float]]
"""Acceleration asked of the hand (m/s^2, W) at a time (s) in a state."""


class Trace(NamedTuple):
    """The true hand at every tick."""

    hands: list[hand.Hand]


class Ideal:
    """The unicycle (1), exact."""

    def __init__(self, start: Pose) -> None:
        self.pose = start
        self._command = Command(0.0, 0.0)

    def tick(self, command: Command) -> tuple[Pose, Command]:
        """Moves on by a period, then takes `command`; what the agent is told."""
        force, torque = (Actuator(value, value, 0.0) for value in self._command)
        self.pose = integrate(self.pose, force, torque, MASS, INERTIA, DT)
        self._command = command
        return self.pose, command


class Rover:
    """A rover that has driven at `start.speed` for a while, behind the bridge's control parts."""

    def __init__(self, start: Pose, leads: Pair, report_dead_band: Pair) -> None:
        self._rover = RoverDynamics(start.x, start.y, start.heading)  # its north is x here, clockwise is not
        self._estimate = Estimate()
        self._setpoint = Setpoint(
            MASS,
            INERTIA,
            Bounds(),
            lead_speed_s=leads[0],
            lead_yaw_s=leads[1],
            report_dead_band=report_dead_band,
        )
        self._now_ns = 0
        self._asked = (start.speed, 0.0)
        self._coming: deque[tuple[int, int, Pose]] = deque()
        self._ages = count()
        for _ in range(20 * RATE_HZ):
            self._move()
            self._estimate.pose_at(self._now_ns)
            self._estimate.command(self._now_ns, *self._asked)
        self._setpoint.step(DT, None, self._estimate.pose_at(self._now_ns).pose, self._estimate.residual)

    @property
    def pose(self) -> Pose:
        rover = self._rover
        return Pose(rover.north, rover.east, rover.yaw, rover.speed, rover.yaw_rate)

    def tick(self, command: Command) -> tuple[Pose, Command]:
        """As `Ideal.tick`."""
        self._move()
        estimate, setpoint = self._estimate, self._setpoint
        pose = estimate.pose_at(self._now_ns).pose
        self._asked = setpoint.step(DT, command, pose, estimate.residual)
        estimate.command(self._now_ns, *self._asked)
        pose = pose._replace(speed=setpoint.speed, yaw_rate=setpoint.yaw_rate)
        return pose, Command(setpoint.force, setpoint.torque)

    def _move(self) -> None:
        end_ns = self._now_ns + PERIOD_NS
        while self._now_ns < end_ns:
            self._rover.step(STEP_NS / NS_PER_S, *self._asked)
            self._now_ns += STEP_NS
            if self._now_ns % PERIOD_NS == PERIOD_NS // 2 // STEP_NS * STEP_NS:
                age_ns = AGES_NS[next(self._ages) % len(AGES_NS)]
                self._coming.append((self._now_ns + age_ns, self._now_ns, self.pose))
        while self._coming and self._coming[0][0] <= self._now_ns:
            _, valid_ns, pose = self._coming.popleft()
            self._estimate.position(valid_ns, pose.x, pose.y, pose.speed)
            self._estimate.attitude(valid_ns, pose.heading, pose.yaw_rate)


def drive(body: Ideal | Rover, law: Law, seconds: float) -> Trace:
    """The loop of `agent.control.controller`: a wrench is for the middle of the period after the next
    tick."""
    hands: list[hand.Hand] = []
    command = Command(0.0, 0.0)
    for k in range(round(seconds * RATE_HZ)):
        told, acting = body.tick(command)
        hands.append(hand.hand(body.pose, REACH))
        then = hand.advance(told, acting.force, acting.torque, MASS, INERTIA, 1.5 * DT)
        ux, uy = law((k + 1.5) * DT, hand.hand(then, REACH))
        command = Command(*hand.wrench(ux, uy, then, MASS, INERTIA, REACH))
    return Trace(hands)


def pulse(ax: float, ay: float) -> Law:
    """An acceleration for one second and, after another, back again."""

    def law(t: float, here: hand.Hand) -> tuple[float, float]:
        sign = 1.0 if 0.5 <= t < 1.5 else -1.0 if 2.5 <= t < 3.5 else 0.0
        return sign * ax, sign * ay

    return law


def navigation(x: float, y: float, vx: float) -> Law:
    """The law of one robot alone (21): to (x, y), which moves at vx."""

    def law(t: float, here: hand.Hand) -> tuple[float, float]:
        ex, ey = here.x - x - vx * t, here.y - y
        return -C1 * ex - C2 * (here.vx - vx), -C1 * ey - C2 * here.vy

    return law


class Case(NamedTuple):
    """One response: the speed to begin with, the law, and for how long."""

    name: str
    speed: float
    law: Law
    seconds: float


CASES: Final = (
    Case("0.5 m/s2 ahead for 1 s and back, from rest", 0.0, pulse(ACCELERATION, 0.0), 5.0),
    Case("0.5 m/s2 astern for 1 s and back, from rest", 0.0, pulse(-ACCELERATION, 0.0), 5.0),
    Case("0.5 m/s2 to the left for 1 s and back, from rest", 0.0, pulse(0.0, ACCELERATION), 5.0),
    Case("0.3 m/s2 to the left for 1 s and back, at 0.34 m/s", CRUISE, pulse(0.0, 0.3), 5.0),
    Case("0.3 m ahead by the law, from rest", 0.0, navigation(REACH + STEP_M, 0.0, 0.0), 15.0),
    Case("0.3 m to the left by the law, from rest", 0.0, navigation(REACH, STEP_M, 0.0), 15.0),
    Case("0.3 m ahead by the law, at 0.34 m/s", CRUISE, navigation(REACH + STEP_M, 0.0, CRUISE), 15.0),
    Case("0.3 m to the left by the law, at 0.34 m/s", CRUISE, navigation(REACH, STEP_M, CRUISE), 15.0),
)
LEADS: Final = (LEAD_SPEED_S, LEAD_YAW_S)
NO_LEADS: Final = (0.0, 0.0)
MEASURED: Final = (0.0, 0.0)
REFERENCE: Final = (inf, inf)
VARIANTS: Final = (
    ("no lead, measured", NO_LEADS, MEASURED),
    ("no lead, reference", NO_LEADS, REFERENCE),
    ("lead, measured", LEADS, MEASURED),
    ("lead, reference", LEADS, REFERENCE),
    ("as shipped", LEADS, REPORT_DEAD_BAND),
)


class Deviation(NamedTuple):
    """Of the hand from the ideal one: largest distance (m), rms of the velocities' difference (m/s)."""

    way: float
    velocity: float


def deviation(trace: Trace, ideal: Trace) -> Deviation:
    # Relative to the start: a rover that was brought to a speed first is somewhere else.
    a0, b0 = trace.hands[0], ideal.hands[0]
    ways, squares = [], []
    for a, b in zip(trace.hands, ideal.hands, strict=True):
        ways.append(hypot(a.x - a0.x - b.x + b0.x, a.y - a0.y - b.y + b0.y))
        squares.append((a.vx - b.vx) ** 2 + (a.vy - b.vy) ** 2)
    return Deviation(max(ways), sqrt(sum(squares) / len(squares)))


def _started(case: Case, body: Callable[[Pose], Ideal | Rover]) -> Trace:
    start = Pose(0.0, 0.0, 0.0, case.speed, 0.0)
    driven = body(start)
    x = driven.pose.x

    def law(t: float, here: hand.Hand) -> tuple[float, float]:
        return case.law(t, here._replace(x=here.x - x))

    return drive(driven, law, case.seconds)


def deviations(leads: Pair, report_dead_band: Pair) -> list[Deviation]:
    """One for each of `CASES`."""
    return [
        deviation(_started(case, lambda start: Rover(start, leads, report_dead_band)), _started(case, Ideal))
        for case in CASES
    ]


def run(options: Options) -> Result:
    found = {name: deviations(leads, report_dead_band) for name, leads, report_dead_band in VARIANTS}
    rows = [
        [case.name, *(f"{1e3 * each[k].way:.0f} / {1e3 * each[k].velocity:.0f}" for each in found.values())]
        for k, case in enumerate(CASES)
    ]
    worst = {name: max(each.way for each in all_) for name, all_ in found.items()}
    shipped, bare = VARIANTS[-1][0], VARIANTS[0][0]
    return Result(
        [
            Figure("hand off the ideal one, worst of all steps, as shipped", worst[shipped], "m"),
            Figure("hand off the ideal one, worst of all steps, no lead, measured speeds", worst[bare], "m"),
        ],
        [
            "Hand against that of an ideal body: largest distance, mm / rms of the velocity, mm/s",
            *table(["step", *found], rows),
        ],
    )
