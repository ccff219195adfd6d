"""Many runs of a fleet over a grid of its fields, in virtual time, on all cores or a cluster."""

from __future__ import annotations

import copyreg
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Unpack, get_type_hints

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.errors import Error, packages_named
from handfast.agent.formation.points import Floats
from handfast.deploy.api.fleet import Changes, Fleet, Source, load, names_known
from handfast.deploy.api.recording import data_frame
from handfast.deploy.api.values import Classes, Known, flags, in_words_of_python, positive, toml, whole
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.progress import make_progress
from handfast.deploy.console.sources import plugins_of
from handfast.deploy.simulate.worker_pool import Work, identity
from handfast.deploy.sweep.plan import Plan, Question, check_cells, make_plan
from handfast.deploy.sweep.run import PASSED, Resources, Row, Runs
from handfast.deploy.sweep.summary import Cell, margin_axis, margins, summarise
from handfast.deploy.sweep.varied import Axis, Range, parse_axis, parse_over
from handfast.deploy.verdict.metrics import columns

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

RUN_S_MAX: Final = 600.0
"""Real time that a run may take."""


class Sweep:
    """What came of a sweep.

    Attributes:
        fields: those that were varied.
        values: of each, in the order of the grid; numbers ascend.
        seeds: how many runs there are of each combination.
    """

    def __init__(self, plan: Plan, rows: Mapping[int, Row], values: Mapping[str, Sequence[object]]) -> None:
        self._plan, self._rows = plan, rows
        self.fields = tuple(values)
        self.values = Known("field", {field: tuple(each) for field, each in values.items()})
        self.seeds = plan.repeat

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each field has."""
        return tuple(len(values) for values in self.values.values())

    @cached_property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """One row for each run: the fields, those that were drawn, ``seed``, ``passed``, ``safe``,
        ``settled``, the metrics (NaN where a run has none), ``reason`` (why it did not pass)."""
        rows = [self._rows[run] for run in range(self._plan.runs)]
        found: dict[str, NDArray[Any]] = {}
        places = np.indices(self.shape).reshape(len(self.shape), len(self._plan.cells))
        for (field, values), place in zip(self.values.items(), places, strict=True):
            found[field] = _column([values[k] for k in np.repeat(place, self.seeds).tolist()])
        drawn = np.array([self._plan.drawn(run) for run in range(self._plan.runs)], dtype=np.float64)
        for place_of, each in enumerate(self._plan.ranges):
            found[each.field] = drawn[:, place_of]
        found["seed"] = np.array([row.seed for row in rows])
        found["passed"] = np.array([row.verdict == PASSED for row in rows])
        found["safe"] = np.array([row.safe is True for row in rows])
        found["settled"] = np.array([row.settled is True for row in rows])
        for name in self.metrics:
            found[name] = np.array([row.numbers.get(name, np.nan) for row in rows])
        found["reason"] = np.array([row.reason for row in rows])
        return Known("column", found)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics that each run has."""
        return tuple(columns())

    def metric(self, name: str) -> Floats:
        """One of `columns` with numbers on the grid: an axis for each field, the last one for the seeds.

        Raises:
            Error: there is no such column, or it holds no numbers.
        """
        numbers = {key: column for key, column in self.columns.items() if column.dtype.kind in "bif"}
        values: Floats = Known("metric", numbers)[name].astype(np.float64).reshape(*self.shape, self.seeds)
        return values

    @property
    def passed(self) -> bool:
        """Whether every run did."""
        return bool(self.columns["passed"].all())

    def fleet(self, run: int) -> Fleet:
        """The fleet of one run, a row of `columns`: to `simulate` it by itself.

        Raises:
            Error: there is no such run.
        """
        number = whole(run, "a run")
        if not 0 <= number < self._plan.runs:
            raise Error(f"there is no run {number}: they are 0 to {self._plan.runs - 1}")
        import tomli_w

        from handfast.agent.fleet.loading import to_dict

        return load(tomli_w.dumps(to_dict(self._plan.fleet(number))))

    def frame(self) -> pandas.DataFrame:
        """`columns` as a pandas DataFrame.

        Raises:
            Error: pandas is not installed.
        """
        return data_frame(self.columns, "Sweep.frame")

    @packages_named("Sweep.plot")
    def plot(self, name: str | None = None) -> Figure:
        """A picture, as a matplotlib Figure: curves over one field; over two and more a heat map of one
        quantity, ``settling_time`` unless named.

        Raises:
            Error: nothing is varied, there is no such quantity, or matplotlib is not installed.
        """
        from handfast.deploy.report.plotting import styled
        from handfast.deploy.sweep.figures import drawings

        if not self.fields:
            raise Error("no field is varied over values: there is nothing to plot")
        axis, cells = margin_axis(self._plan, None), self._cells
        found = margins(self._plan, cells, axis) if axis is not None else []
        known = drawings(self._plan, cells, axis, found)
        draw = Known("picture", known)[next(iter(known)) if name is None else name]
        with styled():
            return draw()

    @cached_property
    def _cells(self) -> Sequence[Cell]:
        return summarise(self._plan, self._rows)

    def __repr__(self) -> str:
        failed = int((~self.columns["passed"]).sum())
        over = ", ".join(f"{field} ({len(values)})" for field, values in self.values.items()) or "nothing"
        return f"<Sweep over {over}: {self._plan.runs} runs, {failed or 'none'} failed>"


def _column(values: Sequence[object]) -> NDArray[Any]:
    """The values of a field, one for each run: as they are if numpy has a type for them, else as texts."""
    shown = [each.__name__ if isinstance(each, type) else each for each in values]
    plain = all(isinstance(each, (bool, int, float, str)) for each in shown)
    return np.array(shown if plain else [str(each) for each in shown])


@names_known
@packages_named("handfast.sweep")
def sweep(
    fleet: Source,
    over: Mapping[str, Iterable[object] | str] | None = None,
    changes: Mapping[str, object] | None = None,
    *,
    seeds: int = 1,
    workers: int | None = None,
    cluster: str | None = None,
    cluster_wait: float | None = None,
    random_starts: bool | float = False,
    check: bool = True,
    progress: bool = False,
    **named: Unpack[Changes],
) -> Sweep:
    """Drives a fleet many times over a grid of its fields, in virtual time, in processes side by side.

    Args:
        fleet, changes, named: as `load` takes them.
        over: values by field, such as ``{"control.kp": [0.5, 1, 2], "faults.loss": [0, 0.2]}``: all
            combinations are driven. Values may be classes: ``{"control.law": [MyLaw, OtherLaw]}``. A text
            ``"0..1.4s"`` is a range: every run draws a number of it, a column.
        seeds: how many runs of each combination, each with other noise; the same ones in each.
        workers: processes (default: the number of cores).
        cluster: drives on the workers of a Dask scheduler: ``tcp://host:port``, ``tls://host:port`` or its
            scheduler file.
        cluster_wait: time to wait while the scheduler has no worker, s (default: 60).
        random_starts: every seed starts somewhere else, in a square with this side (m), or one that suits.
        check: refuses a grid in which `check` finds errors.
        progress: shows on stderr how far it is.

    Raises:
        Error: the grid is not sound; or the cluster cannot be used, or was lost.
    """
    flags(check=check, progress=progress)
    loaded = load(fleet, changes, **named)
    jobs = None if workers is None else whole(workers, "workers", 1)
    wait_s = None if cluster_wait is None else positive(cluster_wait, "cluster_wait")
    seeds = whole(seeds, "seeds", 1)
    classes = Classes(loaded.classes)
    with in_words_of_python():
        resources = Resources(cluster, jobs, wait_s, RUN_S_MAX)
        axes, ranges, values = _axes({} if over is None else over, classes)
        varied = {*values, *(each.field for each in ranges)}
        kept = tuple(each for field, each in loaded.overrides.items() if field not in varied)
        start = _start_square(random_starts)
        plan = make_plan(Question(loaded.source, loaded.text, loaded.law, kept, axes, seeds, start, ranges))
        if check:
            _refuse_errors(plan)
    return Sweep(plan, _drive(plan, classes.known, resources, progress=progress), values)


def _start_square(random_starts: object) -> float | None:
    """What `Question.random_starts` is."""
    if isinstance(random_starts, bool):
        return 0.0 if random_starts else None
    return positive(random_starts, "random_starts")


def _drive(
    plan: Plan, classes: Mapping[str, type], resources: Resources, *, progress: bool
) -> Mapping[int, Row]:
    """All rows of a plan.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    rows: dict[int, Row] = {}
    work: Work[Row] = _Carried(Runs(plan), classes) if classes else Runs(plan)
    interrupt = Interrupt()
    show = make_progress(sys.stderr, plan.runs, quiet=not progress, trouble="unsafe or not settled")
    plugins = plugins_of(plan.cells)
    engine = resources.engine(work, identity(plugins), plugins, show.say)
    with interrupt.caught(), show, engine:
        for row in engine.results(plan.order(), lambda: interrupt.count == 0):
            rows[row.run] = row
            show.add(trouble=not row.good)
    if interrupt.count:
        raise KeyboardInterrupt(f"{len(rows)} of {plan.runs} runs were done")
    return rows


def _axes(
    over: Mapping[str, Iterable[object] | str], classes: Classes
) -> tuple[tuple[Axis, ...], tuple[Range, ...], dict[str, Sequence[object]]]:
    """The grid, what is drawn, and the grid's values by field."""
    if not isinstance(over, Mapping):
        raise Error(f'what is varied is given by field, such as {{"control.kp": [0.5, 1, 2]}}, got {over!r}')
    axes: list[Axis] = []
    ranges: list[Range] = []
    values: dict[str, Sequence[object]] = {}
    for field, given in over.items():
        if isinstance(given, str) and isinstance(drawn := _drawn(field, given), Range):
            ranges.append(drawn)
            continue
        if isinstance(given, (str, bytes, Mapping)) or not isinstance(given, Iterable):
            raise Error(f"{field}: a list of values was expected, got {given!r}")
        if field == "fleet.seed":
            raise Error("fleet.seed: each run has a seed of its own: write for example seeds=20")
        pairs = [(toml(field, value, classes), value) for value in given]
        if not pairs:
            raise Error(f"{field}: no values are given")
        axes.append(parse_axis(f"{field}={','.join(text for text, _ in pairs)}"))
        values[field] = [dict(pairs)[text] for text in axes[-1].values]
    return tuple(axes), tuple(ranges), values


def _drawn(field: str, text: str) -> Axis | Range | None:
    return parse_over(f"{field}={text}") if ".." in text else None


def _refuse_errors(plan: Plan) -> None:
    for finding, (cell, *_) in check_cells(plan):
        if finding.level == "error":
            raise Error(
                f"not started (check=False drives all the same): with {plan.name(cell)}, "
                f"{finding.place}: {finding.message}"
            )


# --- classes on their way to other processes ------------------------------------------------------


class _Carried:
    """Runs that take the classes along which their fleets name, wherever these are defined."""

    def __init__(self, runs: Runs, classes: Mapping[str, type]) -> None:
        import cloudpickle  # by value, what no other process could import

        copyreg.pickle(type(MISSING), lambda _: "MISSING")  # a dataclass looks for this very object
        for plugin in classes.values():
            model = getattr(plugin, "Settings", None)
            if isinstance(model, type):  # their names mean something here, and nothing there
                model.__annotations__ = get_type_hints(model)
        self.execute, self.unfinished = runs.execute, runs.unfinished
        try:
            self._data: bytes = cloudpickle.dumps((runs, classes))
        except Exception as error:  # of pickle or of the classes; each means the same here
            names = ", ".join(sorted(classes))
            raise Error(
                f"{names}: cannot be sent to the processes of a sweep ({error}): put it into a module of its "
                "own and import it from there, or keep in the class what can be pickled"
            ) from None

    def __reduce__(self) -> tuple[Callable[[bytes], Runs], tuple[bytes]]:
        return _arrived, (self._data,)


def _arrived(data: bytes) -> Runs:
    """In a worker: the runs, whose classes it knows from now on."""
    import cloudpickle

    runs, classes = cloudpickle.loads(data)
    Classes(classes).register()
    assert isinstance(runs, Runs)
    return runs
