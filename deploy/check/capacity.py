"""How many robots of a fleet a machine carries, by a model of what their processes cost (PURE).

The costs were measured on one processor (`docs/architecture.md` has which, and how); that of another machine
is that many times as fast as `Machine.speed` says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import floor
from typing import Final, NamedTuple

from handfast.agent.common.compiled import COMPILED
from handfast.agent.control.limits import barrier_rate, speed_max
from handfast.agent.fleet.model import Fleet
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.network import load_of, sharing

ROBOTS_MIN: Final = 13
"""Smaller fleets are not looked at: they fit."""
AGENT_S: Final = 3.6e-3
AGENT_TICK_S: Final = 0.44e-3
MESH_TICK_S: Final = 0.27e-3
AGENT_MESSAGE_S: Final = 38e-6
PLANT_TICK_S: Final = 0.34e-3
SHARED_TICK_S: Final = 0.09e-3
BATCHED_S: Final = 10e-6
ROUTER_MESSAGE_S: Final = 19e-6
RECORDED_S: Final = 70e-6
"""Processor time, s, Zenoh's part in it. Of an agent for a second at any rate (it looks who is near, tells
its status, keeps its links alive), for a round of its loop, so much more where it says what it says to each
of the others, for a message that it hears, and for one that came in a batch (the batch is a message); of a
plant for a round, and of one that shares its process (`deploy.check.load.sharing`); of a router for a message
that it passes on; of `run` for one that it records."""
AGENT_COMPILED: Final = 0.66
PLANT_COMPILED: Final = 0.85
RUN_COMPILED: Final = 0.87
"""Of these, what each takes where it is compiled (`make compiled`)."""
FULL: Final = 0.7
"""So large a share of a machine may be used: robots all do their rounds at the same time, and starting them
takes more than driving. What is nearly as much slows down at times (`agent.supervision.overload`)."""
SPREAD: Final = 1.15
"""A machine that others use, too, is measured as so many times as fast now as a minute later, at most: 1.09
were found within 23 minutes (`deploy.processes.machine`). What is said to fit leaves room for that: else
`handfast run` would refuse a rate that `handfast check` has just proposed."""
ROOMY: Final = FULL / SPREAD
"""What takes a smaller share of a machine than this is not refused a minute later."""
TIMEOUTS: Final = "plant_timeout_s", "wrench_timeout_s"
TIMEOUT_PERIODS: Final = 3.0
"""Fields of `[control]` that must be at least two periods; with so many one lost message is nothing."""
SPEED: Final = "max_speed_mps"
LOWEST: Final = "rate_min_hz"
"""Fields of `[control]` that are lower at a lower rate."""
RATES_HZ: Final = (50.0, 40.0, 30.0, 25.0, 20.0, 15.0, 12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.0)
"""Rates that are proposed."""


class Machine(NamedTuple):
    """A machine that robots are to run on.

    cores: how many processors may be used. speed: how fast one is, against that on which the costs were
    measured.
    """

    cores: float
    speed: float


class Cost(NamedTuple):
    """Processor time in a second while all is well, s, on the machine on which the costs were measured: of
    one agent, of one plant, of all routers together, of `run`; and how many robots there are."""

    agent: float
    plant: float
    routers: float
    run: float
    robots: int

    @property
    def robot(self) -> float:
        """Of a robot, with its share of the routers and of `run`."""
        return self.agent + self.plant + (self.routers + self.run) / self.robots

    @property
    def whole(self) -> float:
        return self.robots * self.robot


def cost_of(fleet: Fleet, robots: int | None = None) -> Cost:
    """What `fleet` costs, or one of as many robots like these; of a larger one each hears more beacons."""
    rate, count = fleet.fleet.rate_hz, len(fleet.robots) if robots is None else robots
    load = load_of(fleet, count)
    shared = sum(map(len, sharing(fleet))) / len(fleet.robots)
    plant_s = shared * SHARED_TICK_S + (1.0 - shared) * PLANT_TICK_S
    tick_s = AGENT_TICK_S + (0.0 if fleet.is_routed else MESH_TICK_S)
    cost = Cost(
        AGENT_S + tick_s * rate + AGENT_MESSAGE_S * (load.alone + load.batches) + BATCHED_S * load.batched,
        plant_s * rate,
        ROUTER_MESSAGE_S * load.routed,
        RECORDED_S * load.recorded,
        count,
    )
    if not COMPILED:
        return cost
    return cost._replace(
        agent=AGENT_COMPILED * cost.agent, plant=PLANT_COMPILED * cost.plant, run=RUN_COMPILED * cost.run
    )


def used(cost: Cost, machine: Machine) -> float:
    """The share of a machine that a fleet uses; above 1 it does not fit."""
    return cost.whole / (machine.cores * machine.speed)


def is_looked_at(fleet: Fleet) -> bool:
    """Whether it matters what a fleet takes."""
    return len(fleet.robots) >= ROBOTS_MIN


def is_refused(fleet: Fleet, machine: Machine) -> bool:
    """Whether a machine carries no such fleet, as it was measured just now."""
    return _takes(fleet, machine) > FULL


def _takes(fleet: Fleet, machine: Machine) -> float:
    """The share that counts: 0 of those that are not looked at."""
    return used(cost_of(fleet), machine) if is_looked_at(fleet) else 0.0


def carried(fleet: Fleet, machine: Machine) -> int:
    """How many robots like those of `fleet` a machine carries, at its rate, whenever it is measured."""
    least, most = 0, 1
    while used(cost_of(fleet, most), machine) <= ROOMY:
        least, most = most, 2 * most
    while most - least > 1:
        middle = (least + most) // 2
        fits = used(cost_of(fleet, middle), machine) <= ROOMY
        least, most = (middle, most) if fits else (least, middle)
    return least


def slower(fleet: Fleet, rate_hz: float) -> Fleet:
    """`fleet` at a lower rate, with timeouts that suit it, with a lowest rate that is no higher, and with a
    speed limit from which robots brake in as short a way as before: else they would have to listen to each
    other from further away."""
    control = fleet.control
    least_s = TIMEOUT_PERIODS / rate_hz
    changes = {name: max(getattr(control, name), least_s) for name in TIMEOUTS}
    if control.rate_min_hz is not None:
        changes[LOWEST] = min(control.rate_min_hz, rate_hz)
    found = replace(fleet, fleet=replace(fleet.fleet, rate_hz=rate_hz), control=replace(control, **changes))
    later = barrier_rate(found) / barrier_rate(fleet)
    if fleet.avoidance.enabled and later < 1.0:
        changes[SPEED] = floor(100.0 * later * speed_max(fleet)) / 100.0
    return replace(found, control=replace(control, **changes))


def that_fits(fleet: Fleet, machine: Machine) -> Fleet | None:
    """`fleet` at the highest of the usual rates, below its own, at which the machine carries it whenever it
    is measured; None where there is none, or `check` finds errors there."""
    for rate_hz in RATES_HZ:
        if rate_hz < fleet.fleet.rate_hz:
            found = slower(fleet, rate_hz)
            if used(cost_of(found), machine) <= ROOMY:
                return None if any(finding.level == "error" for finding in check(found)) else found
    return None


def settings(fleet: Fleet, found: Fleet) -> list[str]:
    """What makes `found`, which `slower` has made of `fleet`, of it: for ``--set``."""
    changes = [f"fleet.rate_hz={found.fleet.rate_hz:g}"]
    for name in (LOWEST, SPEED, *TIMEOUTS):
        if getattr(found.control, name) != getattr(fleet.control, name):
            changes.append(f"control.{name}={getattr(found.control, name):g}")
    return changes


def describe_cost(fleet: Fleet) -> str:
    """What a fleet takes of processors, in a line."""
    cost = cost_of(fleet)
    text = f"a robot takes some {_percent(cost.agent + cost.plant)} of a core"
    text += f" (agent {_percent(cost.agent)}, plant {_percent(cost.plant)})"
    more = f", routers {_percent(cost.routers)} together" if cost.routers else ""
    return f"{text}{more}; recording all takes {_percent(cost.run)}"


def describe_capacity(fleet: Fleet, machine: Machine) -> str:
    """How many robots like these a machine carries, in a sentence without its end."""
    count, cores = carried(fleet, machine), f"{machine.cores:g} core{'s' * (machine.cores != 1)}"
    text = f"this machine ({cores}) carries about {count} robots like these at {fleet.fleet.rate_hz:g} Hz"
    return f"{text}; {len(fleet.robots)} may be slowed down at times" if _is_tight(fleet, machine) else text


def overload(fleet: Fleet, machine: Machine) -> str:
    """Why a machine does not carry `fleet`, and what would fit, as a sentence without its end; "" where it
    does."""
    return _too_much(fleet, machine) if is_refused(fleet, machine) else ""


def _is_tight(fleet: Fleet, machine: Machine) -> bool:
    """Whether the machine carries `fleet`, but may not when it is measured again."""
    return ROOMY < _takes(fleet, machine) <= FULL


def _too_much(fleet: Fleet, machine: Machine) -> str:
    n, needs = len(fleet.robots), cost_of(fleet).whole / machine.speed
    found = that_fits(fleet, machine)
    if found is None:
        advice = "drive fewer, on a larger machine or in virtual time (`handfast simulate`)"
    else:
        words = " ".join(f"--set {change}" for change in settings(fleet, found))
        advice = f"all {n} fit at {found.fleet.rate_hz:g} Hz: {words}"
    return (
        f"{n} robots at {fleet.fleet.rate_hz:g} Hz need about {needs:.2g} cores, and "
        f"{describe_capacity(fleet, machine)}; {advice}"
    )


def check_capacity(fleet: Fleet, machine: Machine) -> Iterator[Finding]:
    """Warns of a fleet that this machine does not carry with `handfast run`, or may not, says how many it
    does."""
    if not is_looked_at(fleet):
        return
    place = "fleet.rate_hz"
    if is_refused(fleet, machine):
        yield Finding("warning", place, f"`handfast run` refuses it here: {_too_much(fleet, machine)}")
    elif _is_tight(fleet, machine):
        text = "`handfast run` may refuse it here, where others use this machine, too"
        yield Finding("warning", place, f"{text}: {_too_much(fleet, machine)}")
    else:
        yield Finding("info", place, describe_capacity(fleet, machine))


def _percent(cores: float) -> str:
    return f"{100.0 * cores:.2g} %"
