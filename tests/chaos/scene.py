"""A scenario while it is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from handfast.agent.common.quantities import Vector
from tests.chaos.dice import Dice, Tables
from tests.chaos.layout import Shape
from tests.chaos.presets import Preset


@dataclass
class Scene:
    """What has been drawn of a scenario so far. Times in s of the drive, SI units otherwise.

    Attributes:
        members, reserve: ids of the robots in the formation and of the others.
        groups: members that start apart from the others; empty if all start together.
        starts: hands of all robots at the start.
        meet_s: when groups that start apart have met; 0 if there are none.
        late_s: how late messages are at most.
        timeout_periods: timeouts of plants and wrenches in periods.
        rules, orders: ``[[faults.rule]]`` and ``[[order]]``.
        last_s: when the last of them begins or ends.
        trouble_s: when faults of any kind end, and when the last order is given.
    """

    dice: Dice
    preset: Preset
    rate_hz: int
    safe_m: float
    speed: float
    acceleration: float
    reach_m: float
    members: Sequence[int]
    reserve: Sequence[int]
    trouble_s: float
    shape: Shape = field(default_factory=lambda: Shape({}, ()))
    groups: Sequence[Sequence[int]] = ()
    starts: Mapping[int, Vector] = field(default_factory=dict)
    meet_s: float = 0.0
    late_s: float = 0.0
    timeout_periods: float = 0.0
    last_s: float = 0.0
    rules: list[Tables] = field(default_factory=list)
    orders: list[Tables] = field(default_factory=list)

    @property
    def ids(self) -> list[int]:
        """Ids of all robots."""
        return sorted([*self.members, *self.reserve])

    def add_rule(self, kind: str, rule: Tables) -> Tables:
        """Add a fault rule, named by its kind and number, and return it."""
        self.rules.append({"name": f"{kind} {len(self.rules) + 1}", **rule})
        self.last_s = max(self.last_s, rule.get("until", rule.get("at", 0.0) + rule.get("for", 0.0)))
        return self.rules[-1]

    def add_order(self, order: Tables) -> None:
        """Add an order."""
        self.orders.append(order)
        self.last_s = max(self.last_s, order["at"])
