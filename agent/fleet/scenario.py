"""Files of faults or of orders: some tables of a fleet file, and nothing else (PURE).

The text of live faults, and orders that are given by hand, are read as such files are.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from handfast.agent.common.models import build
from handfast.agent.common.reader import Problem, Reader
from handfast.agent.common.settings import about
from handfast.agent.common.wording import show
from handfast.agent.fleet.fault_checks import check_faults
from handfast.agent.fleet.fault_rules import FaultsSection
from handfast.agent.fleet.orders import OrderSection, check_orders
from handfast.agent.fleet.sections import REPLACED


@dataclass(frozen=True, slots=True)
class Scenario:
    """A file of faults, or the text of live ones: the tables of a fleet file, and nothing else."""

    faults: FaultsSection = field(default_factory=FaultsSection, metadata=about("Faults."))


class ScenarioError(ValueError):
    """A scenario that cannot be used; `problems` as a fleet file's."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


def parse_scenario(text: str, ids: Sequence[int]) -> FaultsSection:
    """The faults in a TOML text, for a fleet of the robots `ids`.

    Raises:
        ScenarioError: with every problem of the text.
    """
    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError([Problem("", f"not valid TOML: {show(str(error), 200)[1:-1]}")]) from None
    reader = Reader(Scenario, REPLACED)
    values = reader.read(raw)
    check_faults(values.get("faults", {}), ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(Scenario, values).faults


@dataclass(frozen=True, slots=True)
class _Orders:
    orders: tuple[OrderSection, ...] = field(default=(), metadata=about("Orders.", key="order"))


def read_orders(raw: Mapping[str, Any], ids: Sequence[int]) -> tuple[OrderSection, ...]:
    """The orders in these tables, for a fleet of the robots `ids`.

    Raises:
        handfast.agent.fleet.scenario.ScenarioError: with every problem; something else than ``[[order]]`` is
        one.
    """
    reader = Reader(_Orders)
    values = reader.read(raw)
    check_orders(values.get("orders", ()), raw, ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(_Orders, values).orders
