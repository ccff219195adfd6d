"""What many scenarios came to: what was drawn, what the robots went through, what was violated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from agent.supervision.state_machine import TRANSITIONS, State
from deploy.chaos.dice import Tables
from deploy.chaos.draw import PROFILES, profile_of
from deploy.chaos.run import CAUGHT, ELSEWHERE, IN_FORMATION, SOON, Outcome

NOT_DRAWN: Final[Mapping[str, str]] = {
    "numbers_failed": "the law gave a number that is none: nothing that is drawn may lead to it",
    "rescheduled": "a mission with another epoch: an order keeps it",
}
"""Transitions of supervision that no scenario can lead to, and why."""


@dataclass(frozen=True, slots=True)
class Driven:
    """One seed's scenario and what came of it; `small` is the shrunk one as tables, with its outcome."""

    seed: int
    tables: Tables
    outcome: Outcome
    small: tuple[Tables, Outcome] | None = None


@dataclass
class Tally:
    """Sums over scenarios."""

    scenarios: int = 0
    driven_s: float = 0.0
    limits: int = 0
    drawn: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    transitions: Counter[str] = field(default_factory=Counter)
    checked: Counter[str] = field(default_factory=Counter)
    profiles: Counter[tuple[str, str]] = field(default_factory=Counter)
    ended: Counter[str] = field(default_factory=Counter)
    failed: list[Driven] = field(default_factory=list)

    def add(self, driven: Driven) -> None:
        outcome = driven.outcome
        self.scenarios += 1
        self.driven_s += outcome.driven_s
        self.limits += outcome.limits
        self.drawn.update(parts(driven.tables))
        self.states.update(outcome.states)
        self.transitions.update(outcome.transitions)
        self.checked.update(outcome.checked)
        self.ended[outcome.ended] += 1
        self.profiles.update(_of_profile(driven))
        if outcome.violations:
            self.failed.append(driven)

    @property
    def violations(self) -> int:
        return sum(len(driven.outcome.violations) for driven in self.failed)

    @property
    def missing(self) -> list[str]:
        """Transitions that could have been and never were."""
        return [
            row.name for row in TRANSITIONS if row.name not in self.transitions and row.name not in NOT_DRAWN
        ]


def _of_profile(driven: Driven) -> Iterator[tuple[str, str]]:
    """What a scenario adds to the table of profiles: (profile, column)."""
    profile, outcome = profile_of(driven.seed), driven.outcome
    yield profile, "driven"
    yield profile, outcome.ended
    if outcome.violations:
        yield profile, "failed"
    for oracle in outcome.oracles:
        yield profile, oracle


def parts(tables: Tables) -> Counter[str]:
    """How many there are of everything that can be drawn."""
    found: Counter[str] = Counter()
    found["robots"] = len(tables["robot"])
    found["robots in reserve"] = sum(bool(row.get("reserve")) for row in tables["robot"])
    found["obstacles"] = len(tables.get("obstacle", ()))
    found["geofences"] = "geofence" in tables
    found["dead-man's switches"] = "deadman_s" in tables.get("supervision", {})
    faults = tables.get("faults", {})
    for effect in ("delay", "loss"):
        found[f"fault: {effect} everywhere"] = effect in faults
    for order in tables.get("order", ()):
        found[f"order: {order['kind']}"] += 1
    for rule in faults.get("rule", ()):
        kind, *_ = str(rule.get("name", "rule")).split()
        if kind == "link":
            for effect in ("delay", "loss", "duplicate", "reorder", "corrupt", "slot"):
                found[f"fault: {effect}"] += effect in rule
        elif kind == "process":
            for what in ("kill", "pause", "restart"):
                if what in rule:
                    for_good = " for good" * (what == "kill" and "for" not in rule)
                    found[f"fault: {what} {rule[what]}{for_good}"] += 1
        else:
            found[f"fault: {_FAULTS.get(kind, kind)}"] += 1
    return +found


_FAULTS: Final = {
    "own": "between agent and plant",
    "clock": "clock skew or drift",
    "jitter": "late ticks",
    "stalls": "processes that stand now and then",
    "dropout": "measurements not taken",
    "range": "links of limited range",
    "deaf": "deaf one way",
    "strangers": "never heard",
}


def lines(tally: Tally) -> Iterator[str]:
    """Tables of what was drawn and of what was exercised, for people."""
    yield "profiles:"
    yield from _table(tally)
    yield "drawn:"
    yield from _columns(sorted(tally.drawn.items()))
    yield "judged by:"
    yield from _columns(sorted(tally.checked.items()))
    yield "at the end:"
    yield from _columns([(name, tally.ended[name]) for name in (IN_FORMATION, CAUGHT, SOON, ELSEWHERE)])
    yield "states come into:"
    yield from _columns([(state.value, tally.states[state.value]) for state in State])
    yield f"transitions taken (and {tally.limits} ticks in which the safety filter changed the command):"
    names = dict.fromkeys(row.name for row in TRANSITIONS)
    yield from _columns([(name, tally.transitions[name]) for name in names if name not in NOT_DRAWN])
    if tally.missing:
        yield f"never taken: {', '.join(tally.missing)}"
    for name, why in NOT_DRAWN.items():
        yield f"  not drawn: {name} ({why})"


def _table(tally: Tally) -> Iterator[str]:
    """A row for each profile: scenarios, those that failed and by which oracles, and how they ended."""
    ends = (IN_FORMATION, CAUGHT, SOON, ELSEWHERE)
    heads = ("scenarios", "failed", *ends)
    width = max(map(len, PROFILES))
    yield f"  {'':<{width}}  {'  '.join(heads)}"
    for profile in PROFILES:
        counts = {what: count for (name, what), count in tally.profiles.items() if name == profile}
        if not counts:
            continue
        cells = [counts.pop(key, 0) for key in ("driven", "failed", *ends)]
        row = "  ".join(f"{cell:>{len(head)}}" for head, cell in zip(heads, cells, strict=True))
        by = ", ".join(f"{oracle} {count}" for oracle, count in sorted(counts.items()) if oracle)
        yield f"  {profile:<{width}}  {row}{'  ' * bool(by)}{by}"


def _columns(items: Sequence[tuple[str, int]], columns: int = 3) -> Iterator[str]:
    width = max((len(name) for name, _ in items), default=0)
    cells = [f"{name:<{width}}{count:>9}" for name, count in items]
    rows = -(-len(cells) // columns)
    for row in range(rows):
        yield "  " + "    ".join(cells[row::rows]).rstrip()


def conclusion(tally: Tally) -> str:
    """One line: how many, what was violated, how long they drove."""
    hours, minutes = divmod(round(tally.driven_s / 60.0), 60)
    driving = f"{hours} h {minutes} min" if hours else f"{minutes} min"
    scenarios = f"{tally.scenarios} scenario{'s' * (tally.scenarios != 1)}"
    violations = f"{tally.violations} violation{'s' * (tally.violations != 1)}"
    return f"{scenarios}, {violations}, {driving} of driving"
