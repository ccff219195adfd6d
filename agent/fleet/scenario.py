"""A file of faults, or the text of live ones: the tables of a fleet file, and nothing else (PURE)."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field

from agent.common.schema import Problem, Reader, about, build, show
from agent.fleet.fault_checks import check_faults
from agent.fleet.fault_rules import FaultsSection


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
    reader = Reader(Scenario)
    values = reader.read(raw)
    check_faults(values.get("faults", {}), ids, reader)
    if reader.problems:
        raise ScenarioError(reader.problems)
    return build(Scenario, values).faults
