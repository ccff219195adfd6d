"""The picture of runs that draw their fields."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from handfast.deploy.sweep.drawn_figure import runs_at_their_draws
from handfast.deploy.sweep.plan import Plan, make_plan
from handfast.deploy.sweep.run import CRASHED, Row, unfinished
from tests.unit.deploy.sweep.asked import NEVER, ask, made


def one_field(repeat: int = 5) -> Plan:
    return make_plan(ask("faults.delay=0..1.4s", repeat=repeat))


def rows_of(
    plan: Plan, *never: int, unsafe: tuple[int, ...] = (), died: tuple[int, ...] = ()
) -> dict[int, Row]:
    rows = {}
    for run in range(plan.runs):
        numbers = {"settling_time_s": NEVER} if run in never else {}
        numbers |= {"min_distance_m.any": 0.1} if run in unsafe else {}
        rows[run] = (
            unfinished(plan, run, CRASHED, "it died", 1.0) if run in died else made(plan, run, **numbers)
        )
    return rows


def points(*panels: Axes) -> list[tuple[float, float]]:
    """All that is drawn in these axes."""
    return [
        (float(x), float(y))
        for axes in panels
        for dots in axes.collections
        for x, y in np.asarray(dots.get_offsets())
    ]


def labels(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_of_two_fields_every_run_is_at_its_draw_and_all_that_might_have_been_drawn_is_shown() -> None:
    plan = make_plan(ask("faults.delay=0..1.4s", "faults.loss=0..50%", repeat=5))
    figure = runs_at_their_draws(plan, rows_of(plan, 1, died=(4,)))
    axes = figure.axes[0]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert left < 0.0 < 1.4 < right < 1.5
    assert low < 0.0 < 0.5 < high < 0.6
    drawn = {(float(x), float(y)) for x, y in (plan.drawn(run) for run in range(5))}
    assert set(points(axes)) >= drawn
    assert labels(figure) == ["1 not settled", "1 not finished"]
    assert axes.get_legend() is None, "among points its markers would be runs"


def test_runs_that_never_settled_are_at_no_time() -> None:
    plan = one_field()
    figure = runs_at_their_draws(plan, rows_of(plan, 0, 3, died=(4,)))
    above, times = figure.axes
    assert [text.get_text() for text in above.get_yticklabels()] == ["2 not settled", "1 not finished"]
    assert {time for _, time in points(times)} == {5.0}
    assert sorted(row for _, row in points(above)) == [0.0, 0.0, 1.0]
    assert times.get_ylim()[0] == 0.0


def test_where_all_settled_there_is_nothing_above() -> None:
    plan = one_field()
    figure = runs_at_their_draws(plan, rows_of(plan, unsafe=(2,)))
    (times,) = figure.axes
    assert labels(figure) == ["1 unsafe"]
    assert times.get_title() == "5 runs, 5 settled"


def test_where_none_settled_times_are_not_below_zero() -> None:
    plan = one_field(3)
    figure = runs_at_their_draws(plan, rows_of(plan, 0, 1, 2))
    low, high = figure.axes[-1].get_ylim()
    assert low == 0.0 < high


def test_ticks_of_a_narrow_range_say_their_numbers() -> None:
    plan = make_plan(ask("datum.longitude_deg=149.16521..149.16524", fleet="rovers", repeat=2))
    figure = runs_at_their_draws(plan, rows_of(plan))
    figure.canvas.draw()
    ticks = [text.get_text() for text in figure.axes[-1].get_xticklabels()]
    assert all(each.startswith("149.1652") for each in ticks), ticks
    assert 2 <= len(ticks) <= 8
