"""What memory a robot's agent and plant take under ten minutes of each attack: it must not grow.

Three robots of a secured fleet, as real processes; of robot 1's the resident memory is looked at once a
second while one attack goes on: strangers' connections, and what somebody can say who has robot 2's key.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import zenoh

from agent.messages import key_expressions
from agent.messages.codec import encode
from agent.messages.types import Heartbeat, Stop
from tests.benchmarks.figures import Figure, Options, Result
from tests.benchmarks.soak import Memory, rss_mb
from tests.process import attackers
from tests.process.flooding import flooding, targets_of
from tests.process.secured_fleet import TAKEN, SecuredRobots, secured_robots, three

MINUTES: Final = 10.0
QUICK_MINUTES: Final = 1.5
GROWTH_MB: Final = 1.0
"""In ten minutes, of one process."""
SETTLED_S: Final = 30.0
STEP_S: Final = 0.05
CONNECTIONS_PER_S: Final = 60
HUGE: Final = 64_000_000
Say = Callable[[zenoh.Session, SecuredRobots], None]


def _beacons(session: zenoh.Session, fleet: SecuredRobots) -> None:
    key = key_expressions.beacon(fleet.name, TAKEN)
    genuine = attackers.as_robot(fleet.name, TAKEN, time.time_ns()).get(key, b"beacon")
    for _ in range(50):
        session.put(key, genuine)


def _nonsense(session: zenoh.Session, fleet: SecuredRobots) -> None:
    for key in attackers.own_keys(fleet.name):
        session.put(key, os.urandom(2_000))


def _forged(session: zenoh.Session, fleet: SecuredRobots) -> None:
    key, now_ns = key_expressions.relayed(fleet.name, TAKEN), time.time_ns()
    files = fleet.keys.files(fleet.keys.robot(TAKEN))
    for number in range(5):
        session.put(key, attackers.sealed(files, encode(Stop(now_ns + number, now_ns, "forged")), now_ns))
        session.put(key, attackers.sealed(files, encode(Heartbeat(now_ns, "forged")), now_ns))


def _as_others(session: zenoh.Session, fleet: SecuredRobots) -> None:
    for key in (
        key_expressions.hand(fleet.name, 1),
        key_expressions.hand(fleet.name, "*"),
        f"{fleet.name}/**",
    ):
        for _ in range(10):
            session.put(key, b"x" * 200)


def _huge(session: zenoh.Session, fleet: SecuredRobots) -> None:
    session.put(
        key_expressions.beacon(fleet.name, TAKEN),
        bytes(HUGE),
        congestion_control=zenoh.CongestionControl.BLOCK,
    )


def _declarations(session: zenoh.Session, fleet: SecuredRobots) -> None:
    declared: list[Any] = []
    for _ in range(20):
        one = f"{fleet.name}/{os.urandom(4).hex()}"
        declared += [
            session.declare_subscriber(f"{one}/**", lambda _: None),
            session.liveliness().declare_token(one),
        ]
    for each in declared:
        each.undeclare()


SAYS: Final[dict[str, Say | None]] = {
    "nothing": None,
    "a thousand beacons a second": _beacons,
    "nonsense on all keys": _nonsense,
    "forged seals": _forged,
    "as others, and wildcards": _as_others,
    "messages of 64 MB": _huge,
    "declarations": _declarations,
}
CONNECTIONS: Final = ("broken", "hello", "silent", "garbage")


def run(options: Options) -> Result:
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    result = Result()
    for name, say in SAYS.items():
        _take(result, name, lambda fleet, say=say: _saying(fleet, say), minutes)  # type: ignore[misc]
    for kind in CONNECTIONS:
        _take(result, f"connections: {kind}", lambda fleet, kind=kind: _flooding(fleet, kind), minutes)  # type: ignore[misc]
    return result


def _take(result: Result, name: str, attack: Callable[[SecuredRobots], Any], minutes: float) -> None:
    memories = {"agent": Memory(), "plant": Memory()}
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder, ExitStack() as stack:
        fleet = stack.enter_context(secured_robots(three(), Path(folder) / "f"))
        fleet.drive()
        step = stack.enter_context(attack(fleet))
        begun = time.monotonic()
        sampled = 0.0
        while (t := time.monotonic() - begun) < 60.0 * minutes:
            step()
            fleet.collect()
            fleet.heard.clear()
            if t >= sampled:
                sampled = t + 1.0
                for role, memory in memories.items():
                    memory.t_s.append(t)
                    memory.mb.append(rss_mb(fleet.processes[1, role].pid))
            time.sleep(STEP_S)
        died = fleet.died()
    for role, memory in memories.items():
        spent = f"{memory.mb[0]:.1f} to {memory.mb[-1]:.1f} MB in {minutes:g} min"
        note = f"{spent}; {', '.join(died)}" if died else spent
        grown = memory.slope(SETTLED_S)
        result.figures.append(Figure(f"{name}: {role}, growth in 10 min", grown, "MB", GROWTH_MB, note=note))
        print("  ".join(filter(None, result.figures[-1].row())), flush=True)


@contextmanager
def _saying(fleet: SecuredRobots, say: Say | None) -> Iterator[Callable[[], None]]:
    """Says something in every step, as who has the key of the robot that was taken over."""
    if say is None:
        yield lambda: None
        return
    endpoints = [fleet.endpoints[1, "agent"], fleet.endpoints[1, "plant"]]
    settings = fleet.keys.security(fleet.keys.robot(TAKEN)).settings()
    with attackers.attacks(endpoints, settings) as session:
        yield lambda: say(session, fleet)


@contextmanager
def _flooding(fleet: SecuredRobots, kind: str) -> Iterator[Callable[[], None]]:
    """Opens connections without a certificate."""
    targets = targets_of(fleet.endpoints[1, role] for role in ("agent", "plant"))
    with flooding(targets, CONNECTIONS_PER_S, kind):
        yield lambda: None
