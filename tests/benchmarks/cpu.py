"""CPU of one robot, agent and plant, against a bare Zenoh program that moves the same messages.

All arms have the same processes, links, keys, message sizes (those that the agents really sent), rates,
wake-ups and inboxes, and the same observer listens to them; only robots that are near without being
neighbours are listened to by ours alone. They take turns, so that what else the machine does falls on all.
The target is against Zenoh as it comes. The third arm, the bare program with our own setting of Zenoh's
threads (`agent.transport.bus.RUNTIME`), shows what is left as the cost of Python, decoding and the law.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final

from handfast.agent.core import Agent
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.node import Node
from handfast.agent.transport import bus
from handfast.deploy.console.arguments import fleet_path
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet
from tests.benchmarks.figures import Figure, Options, Result, spread, table
from tests.benchmarks.processes import ROLES, Cost, Group, Traffic, measure, start_handfast

BARE: Final = Path(__file__).with_name("bare.py")
AS_IT_COMES: Final = {"ZENOH_RUNTIME": ""}
AS_OURS: Final = {"ZENOH_RUNTIME": bus.RUNTIME}
TARGET: Final = 1.5
UNSEEN_SIZE: Final = 64


def start_bare(
    group: Group,
    fleet: Fleet,
    _fleet_file: Path,
    *,
    seen: Traffic,
    window_s: float,
    environment: dict[str, str],
) -> None:
    """Bare programs in the places of the fleet's agents and plants.

    `seen`, of a window of `window_s`, says how large messages are and how often they come.
    """
    ticks = fleet.fleet.rate_hz * window_s

    def publications(node: Node) -> list[tuple[str, int, int]]:
        return [
            (key, round(seen.sizes[key] / count), max(1, round(ticks / count)))
            for key in node.publications
            if (count := seen.counts.get(key, 0))
        ]

    for robot in fleet.ids:
        agent, plant = Agent(fleet, robot), PlantNode(fleet, robot, from_fleet(fleet, robot))
        ends = {
            "agent": (
                [fleet.agent_endpoint(robot)],
                [fleet.agent_endpoint(other) for other in fleet.ids[: fleet.index(robot)]],
            ),
            "plant": ([fleet.plant_endpoint(robot)], [fleet.agent_endpoint(robot)]),
        }
        nodes: dict[str, Node] = {"agent": agent, "plant": plant}
        for role, node in nodes.items():
            listen, connect = ends[role]
            order = {
                "listen": listen,
                "connect": connect,
                "subscribe": list(node.subscriptions),
                "publish": publications(node),
                "alive": node.alive_keys[0],
                "period_ns": node.period_ns,
                "phase_ns": node.phase_ns,
                "config": {},
            }
            group.start(robot, role, [sys.executable, "-P", str(BARE), json.dumps(order)], environment)


def run(options: Options) -> Result:
    fleet = resolved(load_fleet(fleet_path("delta")))
    rounds = 2 if options.quick else 5
    times = {"settle_s": 2.0, "window_s": 10.0 if options.quick else 15.0}
    ours: list[Cost] = []
    bares: list[Cost] = []
    tuned: list[Cost] = []
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        for number in range(rounds):

            def ours_once(number: int = number) -> None:
                place = Path(folder) / f"handfast-{number}"
                ours.append(measure(fleet, place, start_handfast, drive=True, **times))

            def seen() -> dict[str, Any]:
                return {"seen": ours[0].traffic, "window_s": times["window_s"]}

            def bare_once(number: int = number) -> None:
                start = partial(start_bare, **seen(), environment=AS_IT_COMES)
                bares.append(measure(fleet, Path(folder) / f"bare-{number}", start, drive=False, **times))

            def tuned_once(number: int = number) -> None:
                start = partial(start_bare, **seen(), environment=AS_OURS)
                tuned.append(measure(fleet, Path(folder) / f"tuned-{number}", start, drive=False, **times))

            # The order of the arms changes from round to round.
            arms = (ours_once, bare_once, tuned_once)
            for arm in arms if number % 2 == 0 else arms[::-1]:
                arm()
    result = Result()
    comparisons: tuple[tuple[str, Callable[[Cost], float], list[Cost]], ...] = (
        ("agent + plant, handfast / bare", lambda cost: cost.robot, bares),
        ("agent, handfast / bare", lambda cost: cost.cpu["agent"], bares),
        ("plant, handfast / bare", lambda cost: cost.cpu["plant"], bares),
        ("agent + plant, handfast / bare with our Zenoh threads", lambda cost: cost.robot, tuned),
    )
    for what, of, against in comparisons:
        ratios = [of(a) / of(b) for a, b in zip(ours, against, strict=True)]
        note = f"rounds {' '.join(f'{ratio:.2f}' for ratio in ratios)}"
        limit = TARGET if what == "agent + plant, handfast / bare" else None
        result.figures.append(Figure(f"CPU {what}", median(ratios), "", limit, note=note))
    rows = []
    for name, costs in (("handfast", ours), ("bare", bares), ("bare, our threads", tuned)):
        messages = [sum(cost.traffic.counts.values()) / times["window_s"] for cost in costs]
        rows.append(
            [
                name,
                *(spread([100.0 * cost.cpu[role] for cost in costs]) for role in ROLES),
                spread([100.0 * cost.robot for cost in costs]),
                *(spread([cost.pss[role] for cost in costs]) for role in ROLES),
                spread(messages),
                spread([cost.load for cost in costs]),
            ]
        )
    heading = [
        "arm",
        "agent CPU %",
        "plant CPU %",
        "robot CPU %",
        "agent MB",
        "plant MB",
        "messages/s",
        "load",
    ]
    result.details += table(heading, rows)
    ticks = [us for cost in ours for us in cost.traffic.tick_us]
    result.details.append(f"tick in these runs: median {median(ticks):.0f} us over {len(ticks)} ticks")
    return result
