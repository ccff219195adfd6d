"""One member of a fleet says whatever its key lets it say: the others drive on, or stop, and stay apart.

Every field of its hand states and beacons takes legal values of any size, or values near the true ones,
message by message. The oracle: nobody's agent raises, no two of the others come closer than the safe
distance, and a tick stays short.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from math import dist
from typing import Any, Final

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.declaration import Field, declared
from handfast.agent.messages.types import Beacon, HandState, Silent
from handfast.agent.messages.validation import Malformed
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation

LIAR: Final = 3
NS_PER_S: Final = 1_000_000_000
TICK_MAX_S: Final = 0.25
"""A tick of one agent, beside whatever else this machine does; today's longest is 0.02 s."""
Lie = Callable[[random.Random, Any, Fleet, int], Any]


def fleet_of(*overrides: str, name: str = "delta") -> Fleet:
    return resolved(
        load_fleet(FLEETS / f"{name}.toml", ["fleet.rate_hz=20", "fleet.duration_s=12", *overrides])
    )


class Hostile(Simulation):
    """A drive in which what the agent of `LIAR` says is passed through `lie` first."""

    def __init__(self, fleet: Fleet, seed: int, lie: Lie) -> None:
        self._draw, self._lie, self.told = random.Random(seed), lie, 0
        self.closest = float("inf")
        self.longest_s = 0.0
        name = fleet.fleet.name
        self._spoilt = {key_expressions.hand(name, LIAR), key_expressions.beacon(name, LIAR)}
        self._at: dict[str, tuple[float, float]] = {}
        self._honest = {key_expressions.hand(name, robot) for robot in fleet.ids if robot != LIAR}
        super().__init__(fleet)

    def publish(self, key: str, payload: bytes) -> None:
        if key in self._spoilt:
            message = self._lie(self._draw, decode(payload), self.fleet, self.now_ns)
            try:
                payload = encode(message)
                decode(payload)
            except (Malformed, OverflowError, ValueError):
                return  # it would not get through
            self.told += 1
        if key in self._honest:
            state = decode(payload)
            assert isinstance(state, HandState)
            self._at[key] = state.x, state.y
            if self.now_ns > self.epoch_ns:
                others = (place for other, place in self._at.items() if other != key)
                self.closest = min([self.closest, *(dist(self._at[key], place) for place in others)])
        super().publish(key, payload)

    def drive(self, seconds: float) -> None:
        """Drives so long, timing every period."""
        assert self.start(round(seconds * NS_PER_S))
        until_ns = self.epoch_ns + round(seconds * NS_PER_S)
        while self.now_ns < until_ns:
            begun = time.perf_counter()
            self.run_until(self.now_ns + self.fleet.period_ns)
            self.longest_s = max(self.longest_s, time.perf_counter() - begun)


# --- what it says -----------------------------------------------------------------------------


def _number(draw: random.Random, field: Field, was: Any) -> Any:
    least, most = field.bounds
    if field.kind is bool:
        return draw.random() < 0.5
    if field.kind is int:
        low, high = int(least if least is not None else -(2**62)), int(most if most is not None else 2**62)
        near = was if isinstance(was, int) else low
        return draw.choice([low, high, draw.randint(low, min(high, low + 12)), min(max(near, low), high)])
    low, high = (-1e12 if least is None else least), (1e12 if most is None else most)
    drawn = draw.choice([0.0, draw.uniform(-3.0, 3.0), draw.uniform(-30.0, 30.0), draw.choice([-1e9, 1e9])])
    return min(max(drawn, low), high)


def _value(draw: random.Random, field: Field, was: Any, fleet: Fleet, now_ns: int) -> Any:
    if field.name == "robot":
        return draw.choice([*fleet.ids, *fleet.ids, draw.randint(1, 9999)])
    if field.name == "time_ns":
        return now_ns + draw.choice([0, 0, -NS_PER_S, 100_000_000, -now_ns, -5 * NS_PER_S])
    if field.kind is not tuple:
        return _number(draw, field, was)
    count = draw.choice([0, 1, 1, 2, min(field.about.rows or 8, 8)])
    if field.item is not None:
        return tuple(_value(draw, field.item, None, fleet, now_ns) for _ in range(count))
    assert field.row is not None
    kind: Any = field.row if field.named else tuple
    return tuple(
        tuple.__new__(kind, [_value(draw, each, None, fleet, now_ns) for each in declared(field.row)])
        for _ in range(count)
    )


def anything(draw: random.Random, message: Any, fleet: Fleet, now_ns: int) -> Any:
    """One to four fields of a message take any legal values."""
    fields = [each for each in declared(type(message)) if each.name not in ("robot", "sequence")]
    chosen = draw.sample(fields, draw.randint(1, 4))
    changes = {each.name: _value(draw, each, getattr(message, each.name), fleet, now_ns) for each in chosen}
    return message._replace(**changes)


def about_others(draw: random.Random, message: Any, fleet: Fleet, now_ns: int) -> Any:
    """Rows about robots of the fleet and others, that are there, or were never, as of now."""
    if not isinstance(message, Beacon):
        return message
    rows = []
    for _ in range(draw.randint(1, 4)):
        robot = draw.choice([*fleet.ids, draw.randint(1, 9999)])
        x, y = draw.uniform(-3.0, 6.0), draw.uniform(-3.0, 6.0)
        to_x = draw.choice([x, x, 1e6])
        rows.append(Silent(robot, now_ns, draw.random() < 0.5, x, y, 0.5, 0.5, to_x, y, 0.0))
    unheard = tuple(robot for robot in fleet.ids if robot != LIAR and draw.random() < 0.3)
    return message._replace(silent=tuple(rows), unheard=unheard)


def overloaded(draw: random.Random, message: Any, fleet: Fleet, now_ns: int) -> Any:
    return message._replace(overload=15) if isinstance(message, Beacon) else message


# --- the oracle -------------------------------------------------------------------------------


def check(fleet: Fleet, seed: int, lie: Lie, seconds: float = 8.0) -> Hostile:
    run = Hostile(fleet, seed, lie)
    run.drive(seconds)
    assert run.told > 50
    assert run.closest >= fleet.formation.safe_distance_m, f"seed {seed}: {run.closest:.3f} m"
    assert run.longest_s < TICK_MAX_S * len(fleet.ids), f"seed {seed}: {run.longest_s:.2f} s"
    return run


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lie", [anything, about_others], ids=lambda lie: str(lie.__name__))
def test_what_one_member_says_neither_ends_nor_endangers_the_others(lie: Lie, seed: int) -> None:
    check(fleet_of(), seed, lie)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3, 33))
@pytest.mark.parametrize("lie", [anything, about_others], ids=lambda lie: str(lie.__name__))
def test_so_do_many_more_lies(lie: Lie, seed: int) -> None:
    check(fleet_of(name="delta" if seed % 2 else "obstacles"), seed, lie, 12.0)


def test_one_that_says_it_is_overloaded_stops_nobody() -> None:
    run = check(fleet_of(), 0, overloaded, 12.0)
    states = {agent.robot: agent.state.value for agent in run.agents if agent.robot != LIAR}
    assert set(states.values()) <= {"running", "degraded"}, states


def test_the_liar_is_heard_as_long_as_it_says_nothing_odd() -> None:
    """The way a lie takes is the way of the truth: without a lie the fleet drives as ever."""
    run = check(fleet_of(), 0, lambda draw, message, fleet, now_ns: message)
    assert {agent.state.value for agent in run.agents} == {"running"}
