"""How many robots of a fleet a machine carries, by a model of what their processes cost (PURE).

The costs were measured on one processor (`docs/architecture.md` has which, and how); that of another machine
is that many times as fast as `Machine.speed` says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from handfast.agent.common.compiled import COMPILED
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
"""Largest share of a machine that a fleet may use: all robots tick at the same time, and starting them takes
more than driving."""
ROOMY: Final = 0.6
"""Largest share that is proposed. It is below `FULL`, as a machine with other tenants is measured up to 1.09
times slower some minutes later: `handfast run` must not refuse what `handfast check` has just proposed."""
TIMEOUTS: Final = "plant_timeout_s", "wrench_timeout_s"
TIMEOUT_PERIODS: Final = 3.0
"""Minimum number of periods in these fields of `[control]` at a proposed rate: a lost message is harmless."""
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
    """Return True if a machine, as it was measured just now, does not carry a fleet."""
    return is_looked_at(fleet) and used(cost_of(fleet), machine) > FULL


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


def slower(fleet: Fleet, rate_hz: float) -> tuple[Fleet, list[str]]:
    """Return the fleet at a lower rate, with timeouts and a lowest rate that suit it; and the changes, as
    ``--set`` takes them."""
    control = fleet.control
    changes = {name: max(getattr(control, name), TIMEOUT_PERIODS / rate_hz) for name in TIMEOUTS}
    if control.rate_min_hz is not None:
        changes["rate_min_hz"] = min(control.rate_min_hz, rate_hz)
    found = replace(fleet, fleet=replace(fleet.fleet, rate_hz=rate_hz), control=replace(control, **changes))
    told = [f"control.{name}={value:g}" for name, value in changes.items() if value != getattr(control, name)]
    return found, [f"fleet.rate_hz={rate_hz:g}", *told]


def that_fits(fleet: Fleet, machine: Machine) -> tuple[Fleet, list[str]] | None:
    """Return `slower` for the highest of the usual rates, below the fleet's own, at which the machine carries
    the fleet; None if there is none, or `check` finds errors at that rate."""
    for rate_hz in RATES_HZ:
        if rate_hz < fleet.fleet.rate_hz:
            found, changes = slower(fleet, rate_hz)
            if used(cost_of(found), machine) <= ROOMY:
                return None if any(each.level == "error" for each in check(found)) else (found, changes)
    return None


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
    return f"this machine ({cores}) carries about {count} robots like these at {fleet.fleet.rate_hz:g} Hz"


def overload(fleet: Fleet, machine: Machine) -> str:
    """Return why a machine does not carry a fleet, and what would fit, as a sentence without its end; "" if
    it does."""
    if not is_refused(fleet, machine):
        return ""
    n, needs = len(fleet.robots), cost_of(fleet).whole / machine.speed
    advice = "drive fewer, on a larger machine or in virtual time (`handfast simulate`)"
    if fitting := that_fits(fleet, machine):
        found, changes = fitting
        advice = f"all {n} fit at {found.fleet.rate_hz:g} Hz: --set {' --set '.join(changes)}"
    return (
        f"{n} robots at {fleet.fleet.rate_hz:g} Hz need about {needs:.2g} cores, and "
        f"{describe_capacity(fleet, machine)}; {advice}"
    )


def check_capacity(fleet: Fleet, machine: Machine) -> Iterator[Finding]:
    """Warn if `handfast run` would refuse the fleet on this machine; else say how many robots it carries."""
    if text := overload(fleet, machine):
        yield Finding("warning", "fleet.rate_hz", f"`handfast run` refuses it here: {text}")
    elif is_looked_at(fleet):
        yield Finding("info", "fleet.rate_hz", describe_capacity(fleet, machine))


def _percent(cores: float) -> str:
    return f"{100.0 * cores:.2g} %"
