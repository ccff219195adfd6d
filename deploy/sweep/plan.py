"""What a sweep asks: a grid of fields of the fleet file, each cell driven with the same starts and noise; and
fields that every run draws for itself.

Nothing is driven here. `make_plan` reads the fleet of every cell and says all that is wrong with any of
them; `Plan.fleet` is what one run drives, a pure function of the question and the run's number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from itertools import chain, product
from math import isfinite, prod, sqrt
from typing import Any, Final

from agent.common import random_streams
from agent.common.errors import Error
from agent.common.quantities import UNITS, quantity
from agent.common.reader import Problem
from agent.common.settings import entries
from agent.common.wording import printable, show
from agent.fleet.loading import digest, parse_fleet, to_dict
from agent.fleet.model import Fleet, FleetError
from agent.formation.geometry import resolved
from deploy.simulate.random_starts import random_fleet

RUNS_MAX: Final = 1_000_000
RANGES_MAX: Final = 6
"""Fields that may be drawn: every combination of their ends is read and checked."""
SIDE_M: Final = 4.0
"""Side of the square of random starts for six robots; others have as much room each."""
GAP_M: Final = 0.3
GAP_PER_SAFE: Final = 1.25
"""Random starts are at least this times the safe distance apart (and `GAP_M`)."""
_SEED_SHIFT: Final = 11  # seeds of 53 bits: every program that reads the table holds them exactly
_BRACKETS: Final = {"[": "]", "{": "}"}


class SweepError(Error, ValueError):
    """A sweep that cannot be made; the text is one clear message."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One field that is varied, with its values as they were typed.

    Numbers are in ascending order; `numbers` are the values in the field's unit, None where one of them
    is no number. `unit` is that unit, empty without one.
    """

    field: str
    values: tuple[str, ...]
    numbers: tuple[float, ...] | None
    unit: str

    def __str__(self) -> str:
        return f"{self.field}={','.join(self.values)}"


@dataclass(frozen=True, slots=True)
class Range:
    """One field that every run draws, uniform between two numbers in the field's unit.

    `text` is the range as it was typed; `unit` that unit, empty without one.
    """

    field: str
    low: float
    high: float
    unit: str
    text: str

    def __str__(self) -> str:
        return f"{self.field}={self.text}"

    def value(self, seed: int) -> str:
        """What the run with this `fleet.seed` draws, as a plain number; nothing else is drawn with it."""
        share = random_streams.uniform(random_streams.stream("sweep", seed, self.field), 0)
        return _plain(self.low + (self.high - self.low) * share)

    @property
    def ends(self) -> tuple[str, str]:
        """The least and the greatest that may be drawn."""
        return _plain(self.low), _plain(self.high)


def _plain(number: float) -> str:
    """A number with six digits, as every program reads it."""
    return f"{number:.6g}"


def parse_over(text: str) -> Axis | Range:
    """Reads one ``--over``: values (`parse_axis`), or a range ``table.field=low..high``, whose unit may stand
    behind its end alone.

    Raises:
        SweepError: it is neither.
    """
    path, _, written = text.partition("=")
    low, dots, high = (part.strip() for part in written.partition(".."))
    if not dots or not low or not high:
        return parse_axis(text)
    keys = [key.strip() for key in path.split(".")]
    if number(low, "") is not None:
        low += high.lstrip("+-.0123456789eE")  # 10..50% is 10 % to 50 %
    numbers, unit = _numbers(keys, (low, high))
    if numbers is None:
        return parse_axis(text)
    name = parse_axis(f"{path}={low}").field
    if not numbers[0] < numbers[1]:
        raise SweepError(f"--over {printable(text)}: the range must begin below its end, such as 0..1.4s")
    return Range(name, numbers[0], numbers[1], unit, written.strip())


def parse_axis(text: str) -> Axis:
    """Reads one ``--over``: ``table.field=value,value,...``, split at commas outside quotes and brackets.

    Raises:
        SweepError: it is not of that form, or gives a value twice.
    """
    path, equals, written = text.partition("=")
    keys = [key.strip() for key in path.split(".")]
    name = ".".join(keys)
    if not equals or len(keys) < 2 or not all(keys):
        raise SweepError(
            f"--over {printable(text)}: must be written as table.field=value,value, "
            "such as control.kp=0.5,1,2 or faults.delay=0,50ms,100ms, or drawn: faults.delay=0..1.4s"
        )
    if name == "fleet.seed":
        raise SweepError(
            "--over fleet.seed: every run has a seed of its own already, made of --seed and its repeat: "
            f"write for example --repeat {len(_split(written))}"
        )
    values = [value.strip() for value in _split(written)]
    if not all(values):
        raise SweepError(f"--over {printable(text)}: a value is missing between two commas or at an end")
    numbers, unit = _numbers(keys, values)
    if numbers is not None:
        order = sorted(range(len(values)), key=numbers.__getitem__)
        values, numbers = [values[k] for k in order], [numbers[k] for k in order]
    same: dict[object, str] = {}
    for value, meaning in zip(values, values if numbers is None else numbers, strict=True):
        if meaning in same:
            first = same[meaning]
            again = f"{value} twice" if first == value else f"{first} and {value}, which are the same"
            raise SweepError(f"--over {name}: gives {printable(again)}")
        same[meaning] = value
    return Axis(name, tuple(values), None if numbers is None else tuple(numbers), unit)


def _split(text: str) -> list[str]:
    parts, closing, start = [], "", 0
    for index, letter in enumerate(text):
        if closing and closing[-1] in "\"'":
            closing = closing[:-1] if letter == closing[-1] else closing
        elif letter in "\"'":
            closing += letter
        elif letter in _BRACKETS:
            closing += _BRACKETS[letter]
        elif closing and letter == closing[-1]:
            closing = closing[:-1]
        elif letter == "," and not closing:
            parts.append(text[start:index])
            start = index + 1
    return [*parts, text[start:]]


def _numbers(keys: Sequence[str], values: Sequence[str]) -> tuple[list[float] | None, str]:
    """The values as numbers of one unit, and that unit."""
    unit = _unit(keys)
    # A value class of its own, such as a delay, has no unit: the suffixes say which it is.
    for each in [unit] if unit else UNITS:
        found = [number(value, each) for value in values]
        numbers = [value for value in found if value is not None]
        if len(numbers) == len(values):
            bare = not unit and all(number(value, "") is not None for value in values)
            return numbers, "" if bare else each
    return None, ""


def number(text: str, unit: str) -> float | None:
    """The number that a value such as ``50ms`` is in `unit`, None when it is no such number."""
    text = text.strip().strip("\"'")
    try:
        value = quantity(text, unit) if unit in UNITS else float(text)
    except ValueError:
        return None
    return value if isfinite(value) else None


def _unit(keys: Sequence[str]) -> str:
    """Unit of a field of the fleet file, empty when it has none."""
    model: type | None = Fleet
    rest = list(keys)
    while rest and model is not None:
        entry = entries(model).get(rest.pop(0))
        if entry is None:
            return ""
        if not rest:
            return entry.setting.unit or ""
        if entry.tables is not None:
            rest = rest[1:]  # which entry of the array
        model = entry.table or entry.tables
    return ""


@dataclass(frozen=True, slots=True)
class Question:
    """All that decides what a sweep's runs are.

    Attributes:
        source: names the fleet file in messages.
        text: its text.
        law, overrides: as `agent.fleet.loading.parse_fleet` takes them.
        axes: the varied fields; none: one cell.
        repeat: runs of each cell.
        random_starts: None; or the side of the square that hand points start in, m; or 0.0 for one that
            suits the number of robots.
        ranges: the fields that every run draws.
    """

    source: str
    text: str
    law: str | None = None
    overrides: tuple[str, ...] = ()
    axes: tuple[Axis, ...] = ()
    repeat: int = 1
    random_starts: float | None = None
    ranges: tuple[Range, ...] = ()

    @property
    def varied(self) -> tuple[Axis | Range, ...]:
        """What differs from run to run: the grid's fields, then those that are drawn."""
        return (*self.axes, *self.ranges)


@dataclass(frozen=True, slots=True)
class Plan:
    """The fleets of a question, one for each cell, in the order of the grid: the last axis counts fastest.

    `ranges` are drawn by each run: `texts` are the cells as fleet files, which a run's draws are laid over;
    `cells` have the least of all that is drawn, `extremes` of each cell every further combination of ends.
    `recorded_digest`: that of a sweep whose plugins are not here, so that its fleets lack their tables.
    """

    axes: tuple[Axis, ...]
    repeat: int
    seed: int
    cells: tuple[Fleet, ...]
    side_m: float | None
    gap_m: float
    assign: tuple[bool, ...]
    recorded_digest: str | None = None
    ranges: tuple[Range, ...] = ()
    texts: tuple[str, ...] = ()
    extremes: tuple[tuple[Fleet, ...], ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that differ from run to run: those of the grid, then those that are drawn."""
        return (*(axis.field for axis in self.axes), *(each.field for each in self.ranges))

    def run_values(self, run: int) -> tuple[str, ...]:
        """The values of `fields` in a run."""
        return (*self.values(run // self.repeat), *self.drawn(run))

    def drawn(self, run: int) -> tuple[str, ...]:
        """What a run draws, by `ranges`: of a repeat the same in every cell."""
        seed = self.run_seed(run)
        return tuple(each.value(seed) for each in self.ranges)

    def run_name(self, run: int) -> str:
        """A run's cell and draws in words: ``control.kp=1, faults.delay=0.52``."""
        return _named(self.fields, self.run_values(run))

    @property
    def runs(self) -> int:
        """Number of runs. Run k is repeat ``k % repeat`` of cell ``k // repeat``."""
        return len(self.cells) * self.repeat

    def order(self) -> Iterator[int]:
        """All runs, the first repeat of every cell first: what is done early says something of the whole."""
        for k in range(self.repeat):
            yield from range(k, self.runs, self.repeat)

    def values(self, cell: int) -> tuple[str, ...]:
        """The varied fields' values in a cell."""
        out = []
        for axis in reversed(self.axes):
            cell, place = divmod(cell, len(axis.values))
            out.append(axis.values[place])
        return tuple(reversed(out))

    def name(self, cell: int) -> str:
        """A cell in words: ``control.kp=1, control.c2=0.6``."""
        return _named([axis.field for axis in self.axes], self.values(cell))

    def run_seed(self, run: int) -> int:
        """`fleet.seed` of a run: of a repeat the same in every cell, so that start and noise are the same."""
        return (
            random_streams.bits(random_streams.stream("sweep", self.seed), run % self.repeat) >> _SEED_SHIFT
        )

    def fleet(self, run: int) -> Fleet:
        """The fleet that a run drives, resolved.

        Raises:
            ValueError: the square of random starts has no room, or what is drawn makes no fleet.
        """
        number = run // self.repeat
        return self._started(number, run, self._with(number, self.drawn(run)))

    def samples(self, cell: int) -> list[Fleet]:
        """What a look at a cell before it is driven looks at: its first run; where fields are drawn, that
        with each combination of ends. Raises as `fleet`."""
        run = cell * self.repeat
        if not self.ranges:
            return [self.fleet(run)]
        return [self._started(cell, run, base) for base in (self.cells[cell], *self.extremes[cell])]

    def _with(self, number: int, drawn: Sequence[str]) -> Fleet:
        """The fleet of a cell with what a run has drawn."""
        if not self.ranges:
            return self.cells[number]
        overrides = [f"{each.field}={value}" for each, value in zip(self.ranges, drawn, strict=True)]
        recorded = self.recorded_digest is not None
        return resolved(
            parse_fleet(self.texts[number], source="the sweep", overrides=overrides, recorded=recorded)
        )

    def _started(self, number: int, run: int, base: Fleet) -> Fleet:
        """A fleet with the seed and the start of a run."""
        seed = self.run_seed(run)
        if self.side_m is None:
            return replace(base, fleet=replace(base.fleet, seed=seed))
        return random_fleet(base, seed, self.side_m, self.gap_m, assign=self.assign[number])

    def digest(self) -> str:
        """16 hex digits over the fleets of all cells."""
        if self.recorded_digest is not None:
            return self.recorded_digest
        fleets = chain(self.cells, *self.extremes)
        text = "".join(digest(fleet) for fleet in fleets)
        return blake2b(text.encode(), digest_size=8).hexdigest()

    def identity(self) -> Mapping[str, Any]:
        """What a second sweep must have in common with this one to go on where this one ended."""
        identity: dict[str, Any] = {
            "over": [*map(str, self.axes), *map(str, self.ranges)],
            "repeat": self.repeat,
            "seed": self.seed,
        }
        if self.side_m is not None:
            identity["random_starts_m"] = self.side_m
        return identity | {"fleet_digest": self.digest()}


def make_plan(question: Question, recorded_digest: str | None = None) -> Plan:
    """Reads the fleet of every cell.

    With the digest of a sweep that was driven, for looking at it, plugins that are not here are no problem.

    Raises:
        FleetError: with every problem of every cell, each said once.
        SweepError: what is asked contradicts itself.
    """
    _refuse_contradictions(question)
    bounds = [Axis(each.field, each.ends, None, "") for each in question.ranges]
    found = _Problems((*question.axes, *bounds))
    cells: list[Fleet] = []
    assign: list[bool] = []
    # Random starts want assigned places; whoever names the field decides for himself.
    chosen = "formation.assign" in _fields(question)
    texts: list[str] = []
    extremes: list[tuple[Fleet, ...]] = []
    for values in product(*(axis.values for axis in question.axes)):
        fleets: list[Fleet] = []
        for ends in product(*(each.ends for each in question.ranges)):
            varied = zip(question.varied, (*values, *ends), strict=True)
            given = [f"{each.field}={value}" for each, value in varied]
            overrides = [*question.overrides, *given]
            try:
                fleet = parse_fleet(
                    question.text,
                    source=question.source,
                    overrides=overrides,
                    law=question.law,
                    recorded=recorded_digest is not None,
                )
                fleets.append(resolved(fleet))
                if len(fleets) == 1:
                    assign.append(fleet.formation.assign or not chosen)
                    texts += [_written(fleet)] if question.ranges else []
            except FleetError as error:
                found.add((*values, *ends), error.problems)
            except ValueError as error:
                found.add((*values, *ends), [Problem("", str(error))])
        cells += fleets[:1]
        extremes += [tuple(fleets[1:])] if question.ranges else []
    if found.count:
        raise FleetError(question.source, found.problems())
    side_m = question.random_starts
    if side_m == 0.0:
        side_m = round(SIDE_M * sqrt(len(cells[0].robots) / 6), 2)
    return Plan(
        question.axes,
        question.repeat,
        cells[0].fleet.seed,
        tuple(cells),
        side_m,
        max(GAP_M, *(GAP_PER_SAFE * fleet.formation.safe_distance_m for fleet in chain(cells, *extremes))),
        tuple(assign),
        recorded_digest,
        question.ranges,
        tuple(texts),
        tuple(extremes),
    )


def _written(fleet: Fleet) -> str:
    """A fleet as the text of a fleet file."""
    import tomli_w  # here: only fields that are drawn need it

    return tomli_w.dumps(to_dict(fleet))


def _named(fields: Sequence[str], values: Sequence[str]) -> str:
    return ", ".join(f"{field}={value}" for field, value in zip(fields, values, strict=True)) or "the fleet"


def _fields(question: Question) -> set[str]:
    """Every field that the command line gives."""
    paths = (override.partition("=")[0] for override in question.overrides)
    return {".".join(key.strip() for key in path.split(".")) for path in paths} | {
        each.field for each in question.varied
    }


def _refuse_contradictions(question: Question) -> None:
    names = [each.field for each in question.varied]
    if len(question.ranges) > RANGES_MAX:
        raise SweepError(f"at most {RANGES_MAX} fields may be drawn, {len(question.ranges)} are")
    for name in names:
        if names.count(name) > 1:
            raise SweepError(f"--over {name} is given twice: write all its values after one --over")
    alone = _fields(replace(question, axes=(), ranges=()))
    for name in names:
        if name in alone:
            raise SweepError(f"--over {name} varies a field that --set fixes: give one of them")
    if question.repeat < 1:
        raise SweepError(f"--repeat must be at least 1, got {question.repeat}")
    runs = prod(len(axis.values) for axis in question.axes) * question.repeat
    if runs > RUNS_MAX:
        raise SweepError(f"this grid has {runs:,} runs: at most {RUNS_MAX:,} make a sweep")


class _Problems:
    """What is wrong with the fleets of the cells, each said once, with the values that it comes from."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        self._axes = axes
        self._labels = [f"--set {show(axis.field, 80)[1:-1]}" for axis in axes]
        # (number of the axis, rest of the place, message) -> its values; (None, place, message) -> cells
        self._found: dict[tuple[int | None, str, str], dict[Any, None]] = {}
        self.count = 0

    def add(self, values: tuple[str, ...], problems: Sequence[Problem]) -> None:
        self.count += 1
        for problem in problems:
            for number, label in enumerate(self._labels):
                rest = problem.place.removeprefix(label)
                if rest != problem.place and (not rest or rest[0] in ".["):
                    self._found.setdefault((number, rest, problem.message), {})[values[number]] = None
                    break
            else:
                self._found.setdefault((None, problem.place, problem.message), {})[values] = None

    def problems(self) -> list[Problem]:
        cells = prod(len(axis.values) for axis in self._axes)
        out = []
        for (number, place, message), values in self._found.items():
            if number is None:
                where = f" ({self._cells(list(values))})" if len(values) < cells else ""
                out.append(Problem(place, message + where))
                continue
            axis = self._axes[number]
            each = [f"={value}" for value in values] if len(values) < len(axis.values) else [""]
            out += [Problem(printable(f"--over {axis.field}{value}{place}"), message) for value in each]
        return out

    def _cells(self, cells: Sequence[tuple[str, ...]]) -> str:
        """The values that some cells have in common, else those of the first of them."""
        common = [len({values[number] for values in cells}) == 1 for number in range(len(self._axes))]
        shown = [
            f"{axis.field}={cells[0][number]}"
            for number, axis in enumerate(self._axes)
            if common[number] or not any(common)
        ]
        more = "" if any(common) else f" and in {len(cells) - 1} other cells"
        return f"with --over {', '.join(shown)}{more}"
