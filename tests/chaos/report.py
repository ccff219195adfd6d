"""What many scenarios came to: how often each preset failed and ended how, and what was exercised."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from handfast.agent.supervision.state_machine import TRANSITIONS
from tests.chaos.dice import Tables
from tests.chaos.presets import PRESETS
from tests.chaos.run import ENDS, Outcome
from tests.chaos.scenario import name_of, preset_of
from tests.chaos.text import scenario_text

NOT_DRAWN: Final[Mapping[str, str]] = {
    "numbers_failed": "the law returned a number that is not finite, which would be a bug",
    "rescheduled": "a mission with another epoch, which no order makes",
}
"""Transitions of supervision that no scenario can lead to, and why."""


@dataclass(frozen=True, slots=True)
class Driven:
    """One seed's scenario and outcome; `small` is the shrunk scenario with its outcome."""

    seed: int
    tables: Tables
    outcome: Outcome
    small: tuple[Tables, Outcome] | None = None

    def text(self) -> str:
        """Return the fleet file of the smallest scenario that failed, with what is violated in it."""
        tables, outcome = self.small or (self.tables, self.outcome)
        head = [f"Seed {self.seed} ({preset_of(self.seed)}), {'made smaller' if self.small else 'as drawn'}."]
        head += [f"  {each.oracle}: {each.message}" for each in outcome.violations]
        return "".join(f"# {line}\n" for line in head) + "\n" + scenario_text(tables)

    def write(self, folder: Path) -> Path:
        """Write that file and return its path."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{name_of(self.seed)}.toml"
        path.write_text(self.text(), encoding="utf-8")
        return path


@dataclass
class Tally:
    """Sums over scenarios."""

    scenarios: int = 0
    violations: int = 0
    driven_s: float = 0.0
    limits: int = 0
    drawn: Counter[str] = field(default_factory=Counter)
    transitions: Counter[str] = field(default_factory=Counter)
    checked: Counter[str] = field(default_factory=Counter)
    presets: dict[str, Counter[str]] = field(default_factory=dict)

    def add(self, driven: Driven) -> None:
        """Add a scenario."""
        outcome = driven.outcome
        self.scenarios += 1
        self.violations += len(outcome.violations)
        self.driven_s += outcome.driven_s
        self.limits += outcome.limits
        self.drawn.update(parts(driven.tables))
        self.transitions.update(outcome.transitions)
        self.checked.update(outcome.checked)
        row = self.presets.setdefault(preset_of(driven.seed), Counter())
        row.update(["driven", outcome.ended, *["failed"] * bool(outcome.violations), *outcome.oracles])


def parts(tables: Tables) -> Counter[str]:
    """Count everything of a scenario that can be left out of it."""
    found = Counter({
        "robots": len(tables["robot"]),
        "robots in reserve": sum(bool(row.get("reserve")) for row in tables["robot"]),
        "obstacles": len(tables.get("obstacle", ())),
        "geofences": int("geofence" in tables),
        "dead-man's switches": int("deadman_s" in tables.get("supervision", {})),
    })  # fmt: skip
    found.update(f"order: {order['kind']}" for order in tables.get("order", ()))
    for rule in tables.get("faults", {}).get("rule", ()):
        fields = {"name", "robot", "link", "at", "for", "every", "until", "wipe", "topic"}
        for effect in sorted(set(rule) - fields):
            of = f" {rule[effect]}" if effect in ("kill", "pause", "restart") else ""
            found[f"fault: {effect}{of}{' for good' * (effect == 'kill' and 'for' not in rule)}"] += 1
    return +found


def lines(tally: Tally) -> Iterator[str]:
    """Yield the lines of the report."""
    heads, width = ("driven", "failed", *ENDS), max(map(len, PRESETS))
    yield f"{'preset':<{width}}  {'  '.join(heads)}"
    for preset, counts in sorted(tally.presets.items()):
        row = "  ".join(f"{counts[head]:>{len(head)}}" for head in heads)
        oracles = ", ".join(f"{name} {n}" for name, n in sorted(counts.items()) if name not in heads)
        yield f"{preset:<{width}}  {row}  {oracles}".rstrip()
    yield "drawn:"
    yield from _columns(sorted(tally.drawn.items()))
    yield "scenarios judged by each oracle:"
    yield from _columns(sorted(tally.checked.items()))
    yield f"transitions taken ({tally.limits} ticks in which the safety filter changed the command):"
    names = [name for name in dict.fromkeys(row.name for row in TRANSITIONS) if name not in NOT_DRAWN]
    yield from _columns([(name, tally.transitions[name]) for name in names])
    missing = [name for name in names if not tally.transitions[name]]
    if missing:
        yield f"never taken: {', '.join(missing)}"
    hours, minutes = divmod(round(tally.driven_s / 60.0), 60)
    yield f"{tally.scenarios} scenarios, {tally.violations} violations, {hours} h {minutes} min of driving"


def _columns(items: Sequence[tuple[str, int]], columns: int = 3) -> Iterator[str]:
    width = max((len(name) for name, _ in items), default=0)
    cells = [f"{name:<{width}}{count:>9}" for name, count in items]
    rows = -(-len(cells) // columns)
    for row in range(rows):
        yield "  " + "    ".join(cells[row::rows]).rstrip()
