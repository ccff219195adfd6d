"""``[[order]]`` tables on their own: a file of orders, or one that was given by hand (PURE)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from agent.common.schema import Reader, about, build
from agent.fleet.order_checks import check_orders
from agent.fleet.order_sections import OrderSection
from agent.fleet.scenario import ScenarioError


@dataclass(frozen=True, slots=True)
class _Orders:
    orders: tuple[OrderSection, ...] = field(default=(), metadata=about("Orders.", key="order"))


def read_orders(raw: Mapping[str, Any], ids: Sequence[int]) -> tuple[OrderSection, ...]:
    """The orders in these tables, for a fleet of the robots `ids`.

    Raises:
        agent.fleet.scenario.ScenarioError: with every problem; something else than ``[[order]]`` is one.
    """
    reader = Reader(_Orders)
    values = reader.read(raw)
    check_orders(values.get("orders", ()), raw, ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(_Orders, values).orders
