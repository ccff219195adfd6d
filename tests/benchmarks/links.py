"""What failing links cost: nothing to speak of without faults, and how much with them.

Arms take turns in one process, so that the machine's noise hits all alike.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from statistics import median
from typing import Any, Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.links.fault_plan import FaultPlan
from handfast.agent.links.link_emulator import LinkEmulator
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import TOPICS, HandState
from handfast.deploy.console.arguments import fleet_path
from tests.benchmarks.figures import Figure, Options, Result, number, table

ROBOT: Final = 2
BATCH: Final = 2_000
ROUNDS: Final = 60
IDLE_US: Final = 2.0
PENDING: Final = 10_000
_HAND: Final = TOPICS.index("hand")

SETTINGS: Final[dict[str, tuple[str, ...]]] = {
    "constant delay": ("faults.delay=100ms",),
    "constant delay and loss": ("faults.delay=100ms", "faults.loss=30%"),
    "normal delay": ("faults.delay=normal 80ms 20ms",),
    "normal delay with correlation": ("faults.delay=normal 80ms 20ms 25%",),
    "Gilbert-Elliott loss": ("faults.loss=gemodel 1% 10%",),
    "delay, loss, duplicates, reordering, corruption": (
        "faults.delay=normal 80ms 20ms 25%", "faults.loss=5% 25%", "faults.duplicate=1%",
        "faults.reorder=5%", "faults.corrupt=1%",
    ),
}  # fmt: skip


def fleet(*overrides: str) -> Fleet:
    return resolved(load_fleet(fleet_path("delta"), overrides))


def messages(sender: int, count: int, period_ns: int, begin_ns: int) -> list[tuple[HandState, bytes]]:
    out = []
    for k in range(count):
        message = HandState(sender, k, begin_ns + k * period_ns, True, 1, *(0.5,) * 11, ((ROBOT, 0.1),), ())
        out.append((message, encode(message)))
    return out


def idle_cost(rounds: int) -> tuple[list[float], list[float]]:
    """Time (us) to receive one hand state: through an idle reception, and with nothing in its place."""
    base = fleet()
    agents = [Agent(base, ROBOT) for _ in range(2)]
    bare: Any = agents[1]
    sender = base.neighbours(ROBOT)[0]
    key = key_expressions.hand(base.fleet.name, sender)
    spent: tuple[list[float], list[float]] = [], []
    begin_ns = NS_PER_S
    for turn in range(rounds):
        batch = messages(sender, BATCH, base.period_ns, begin_ns)
        begin_ns += BATCH * base.period_ns
        for which in (0, 1) if turn % 2 else (1, 0):
            receive = agents[which].receive if which == 0 else _receive_without_links(bare)
            begun = time.perf_counter_ns()
            for message, payload in batch:
                receive(message.time_ns + 1, key, payload)
            spent[which].append((time.perf_counter_ns() - begun) / 1e3 / BATCH)
    return spent


def _receive_without_links(agent: Any) -> Callable[[int, str, bytes], None]:
    """`Agent.receive` of a hand state without the look at the ingress."""
    hands, peers = agent._hands, agent._peers

    def receive(now_ns: int, key: str, payload: bytes) -> None:
        message = decode(payload)
        if type(message) is HandState and hands.get(key) == message.robot:
            reason = peers.accept(message, now_ns)
            if reason is not None:
                agent._reject(reason)

    return receive


def decision_cost(overrides: tuple[str, ...], rounds: int) -> float:
    """Time (us) of one message under these settings: decided, delivered and reported."""
    base = fleet(*overrides)
    plan = FaultPlan(base)
    plan.begin(0)
    sender = base.neighbours(ROBOT)[0]
    links = LinkEmulator(plan, ROBOT, {"hand": base.neighbours(ROBOT), "state": (ROBOT,)})
    spent = []
    begin_ns = 0
    for _ in range(rounds):
        batch = messages(sender, BATCH, base.period_ns, begin_ns)
        begin_ns += BATCH * base.period_ns
        begun = time.perf_counter_ns()
        for message, payload in batch:
            links.take("key", payload, _HAND, message)
            links.due(message.time_ns)
            links.traced(message.time_ns)
        spent.append((time.perf_counter_ns() - begun) / 1e3 / BATCH)
    return median(spent)


def pending_cost() -> tuple[float, float, int]:
    """Time (us) to take one message where 10,000 wait, to let one go, and how many waited."""
    base = fleet("faults.delay=normal 1000s 100s")
    plan = FaultPlan(base)
    plan.begin(0)
    sender = base.neighbours(ROBOT)[0]
    links = LinkEmulator(plan, ROBOT, {"hand": base.neighbours(ROBOT)})
    batch = messages(sender, PENDING + BATCH, base.period_ns, 0)
    begun = time.perf_counter_ns()
    for message, payload in batch:
        links.take("key", payload, _HAND, message)
    taken = (time.perf_counter_ns() - begun) / 1e3 / len(batch)
    begun = time.perf_counter_ns()
    let_go = len(links.due(10**14))
    return taken, (time.perf_counter_ns() - begun) / 1e3 / let_go, let_go


def run(options: Options) -> Result:
    rounds = 10 if options.quick else ROUNDS
    result = Result()
    gc.collect()
    gc.disable()
    try:
        through, bare = idle_cost(rounds)
        added = median(through) - median(bare)
        result.figures.append(Figure("no fault configured: added to each message", added, "us", IDLE_US))
        result.details.append(
            f"receive a hand state: {number(median(through))} us, of it links {number(added)} us"
        )
        taken, released, waiting = pending_cost()
        result.figures.append(Figure("messages that wait on one link at most", waiting, "", PENDING))
        result.details.append(
            f"with {waiting} waiting: take {number(taken)} us, deliver {number(released)} us"
        )
        rows = [
            [name, number(decision_cost(settings, rounds // 3 + 1))] for name, settings in SETTINGS.items()
        ]
        result.details += ["", *table(["settings", "us a message"], rows)]
    finally:
        gc.enable()
    return result
