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
from math import cos, hypot, pi, prod, sin, sqrt
from re import compile as pattern
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from handfast.agent.common import random_streams
from handfast.agent.common.reader import Problem
from handfast.agent.common.wording import printable, show
from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.sweep.varied import Axis, Range, SweepError, entry_of, parse_over

if TYPE_CHECKING:
    from handfast.deploy.check.finding import Finding


ATTEMPTS_MAX = 1000  # per robot: a square that is too full is an error, not an endless search


def random_fleet(
    base: Fleet, seed: int, side_m: float = 4.0, gap_m: float = 0.3, *, assign: bool = True
) -> Fleet:
    """`base` with other starts, resolved: robots at rest, their formation turned at random.

    Hand points are uniform in a square of `side_m` round the start of the trajectory, each at least
    `gap_m` from the others; headings are uniform. `assign` gives every robot the slot near it.

    Raises:
        ValueError: the square has no room for so many robots.
    """
    generator = np.random.default_rng([seed, len(base.robots)])
    geometry = resolve(base)
    angle = generator.uniform(-pi, pi)
    turn = np.array(((cos(angle), -sin(angle)), (sin(angle), cos(angle))))
    centre = make_trajectory(base.trajectory).at(0.0)[:2]
    hands: list[tuple[float, float]] = []
    for _ in base.robots:
        for _ in range(ATTEMPTS_MAX):
            x, y = generator.uniform(-0.5 * side_m, 0.5 * side_m, 2).tolist()
            if all(hypot(x - other_x, y - other_y) >= gap_m for other_x, other_y in hands):
                hands.append((x, y))
                break
        else:
            raise ValueError(
                f"no room for {len(base.robots)} robots {gap_m} m apart in a square of {side_m} m"
            )
    robots = []
    for robot, (x, y) in zip(base.robots, hands, strict=True):
        heading = generator.uniform(-pi, pi)
        robots.append(
            replace(
                robot,
                x_m=centre[0] + x - robot.hand_offset_m * cos(heading),
                y_m=centre[1] + y - robot.hand_offset_m * sin(heading),
                heading_rad=heading,
            )
        )
    ids = geometry.ids
    formation = replace(
        base.formation,
        offsets=tuple((float(x), float(y)) for x, y in geometry.offsets @ turn.T),
        edges=tuple((ids[i], ids[j]) for i, j in geometry.edges.tolist()),
        distance_m=tuple(geometry.distances.tolist()),
        assign=assign,
    )
    section = replace(base.fleet, seed=seed)
    return resolved(replace(base, fleet=section, formation=formation, robots=tuple(robots)))


RUNS_MAX: Final = 1_000_000
RANGES_MAX: Final = 6
"""Fields that may be drawn: every combination of their ends is read and checked."""
SIDE_M: Final = 4.0
"""Side of the square of random starts for six robots; others have as much room each."""
SIDE_MAX_M: Final = 1e6
GAP_M: Final = 0.3
GAP_PER_SAFE: Final = 1.25
"""Random starts are at least this times the safe distance apart (and `GAP_M`)."""
_START: Final = pattern(r"robot\.[^.]+\.(x_m|y_m|heading_rad)")
"""Fields that random starts decide."""
_SEED_SHIFT: Final = 11  # seeds of 53 bits: every program that reads the table holds them exactly


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
    question = replace(question, ranges=_settled(question, recorded=recorded_digest is not None))
    bounds = [Axis(each.field, each.ends, None, "") for each in question.ranges]
    found = _Problems((*question.axes, *bounds))
    cells: list[Fleet] = []
    assign: list[bool] = []
    # Random starts want assigned places; whoever names the field decides for himself.
    chosen = "formation.assign" in _fields(question)
    texts: list[str] = []
    extremes: list[tuple[Fleet, ...]] = []
    for values in product(*(axis.values for axis in question.axes)):
        fleets = _cell_fleets(question, values, found, recorded=recorded_digest is not None)
        if found.count:
            continue  # to find all problems of all cells
        (first, resolved_first), *others = fleets
        cells.append(resolved_first)
        assign.append(first.formation.assign or not chosen)
        if question.ranges:
            texts.append(_written(first))
            extremes.append(tuple(each for _, each in others))
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


def _cell_fleets(
    question: Question, values: tuple[str, ...], found: _Problems, *, recorded: bool
) -> list[tuple[Fleet, Fleet]]:
    """Read the fleets of a cell, one for each combination of the ends of what is drawn.

    Returns each as it was read and resolved. Problems go to `found`.
    """
    fleets = []
    for ends in product(*(each.ends for each in question.ranges)):
        varied = zip(question.varied, (*values, *ends), strict=True)
        overrides = [*question.overrides, *(f"{each.field}={value}" for each, value in varied)]
        try:
            fleet = parse_fleet(
                question.text,
                source=question.source,
                overrides=overrides,
                law=question.law,
                recorded=recorded,
            )
            fleets.append((fleet, resolved(fleet)))
        except FleetError as error:
            found.add((*values, *ends), error.problems)
        except ValueError as error:
            found.add((*values, *ends), [Problem("", str(error))])
    return fleets


def check_cells(plan: Plan) -> list[tuple[Finding, list[int]]]:
    """Return the errors and warnings of `check`, each with the cells in which it was found.

    A finding that differs between cells only in its numbers is returned once.

    Raises:
        SweepError: the square of random starts has no room.
    """
    from handfast.deploy.check.check import check

    found: dict[tuple[str, str], tuple[Finding, list[int]]] = {}
    for cell in range(len(plan.cells)):
        try:
            fleets = plan.samples(cell)
        except ValueError as error:
            raise SweepError(f"random starts: {error}") from None
        for finding in chain.from_iterable(map(check, fleets)):
            if finding.level in ("error", "warning"):
                cells = found.setdefault((finding.level, finding.place), (finding, []))[1]
                if cell not in cells[-1:]:
                    cells.append(cell)
    return list(found.values())


def _settled(question: Question, *, recorded: bool) -> tuple[Range, ...]:
    """What is drawn, looked at once more where a field is of a plugin's table: what that is, only the fleet
    says which names the plugin.

    Raises:
        SweepError: no such range can be of the field.
    """
    if all(entry_of(each.field.split(".")) is not None for each in question.ranges):
        return question.ranges
    given = [f"{axis.field}={axis.values[0]}" for axis in question.axes]
    given += [f"{each.field}={each.ends[0]}" for each in question.ranges]
    try:
        fleet = parse_fleet(
            question.text,
            source=question.source,
            overrides=[*question.overrides, *given],
            law=question.law,
            recorded=recorded,
        )
    except FleetError:
        return question.ranges  # which make_plan says with all the rest
    held = [section for holder in (fleet.control, *fleet.robots) for section in holder.sections]
    sections = {name: type(model) for name, model in held}
    again = (parse_over(str(each), sections) for each in question.ranges)
    return tuple(each for each in again if isinstance(each, Range))


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
    started = sorted(field for field in alone | set(names) if _START.fullmatch(field))
    if question.random_starts is not None and started:
        raise SweepError(
            f"--random-starts: draws where robots start and how they stand, {started[0]} as well: leave that "
            "out, or --random-starts"
        )
    if question.random_starts is not None and question.random_starts > SIDE_MAX_M:
        raise SweepError(
            f"--random-starts: a side of {question.random_starts:g} m is too long: at most {SIDE_MAX_M:g} m"
        )
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
