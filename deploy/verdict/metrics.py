"""The metrics of a run, one entry each: `METRICS`. What tells of a metric anywhere takes it from there.

Distances are between hand points, the points that the law controls. All values SI unless named.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from handfast.agent.fleet.loading import law_name
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, resolve
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, Approach, analyse, norm
from handfast.deploy.analysis.places import last_there_s
from handfast.deploy.analysis.rounding import largest, number, percentile
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.verdict import lateness, link_metrics, oracles, reasons
from handfast.deploy.verdict.tracking import Tracking
from handfast.deploy.verdict.violations import Violation


class Evidence:
    """A recording with its analysis, what the oracles found, and the verdict's sentences.

    Asking raises `agent.formation.geometry.FormationError` when the fleet's formation cannot be resolved.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording: Recording = recording

    @property
    def fleet(self) -> Fleet:
        return self.recording.fleet

    @cached_property
    def geometry(self) -> Geometry:
        return resolve(self.fleet)

    @cached_property
    def analysis(self) -> Analysis:
        return analyse(self.recording, self.geometry)

    @cached_property
    def violations(self) -> Mapping[str, Sequence[Violation] | None]:
        """What every oracle found; None where it does not apply."""
        return oracles.examine(self.recording, self.analysis, self.fleet)

    @property
    def passed(self) -> bool:
        return not self.reasons

    @cached_property
    def reasons(self) -> Sequence[str]:
        """Why the verdict failed, as sentences."""
        return reasons.reasons(self.recording, self.analysis, self.violations, self.tracking)

    @cached_property
    def warnings(self) -> Sequence[str]:
        return reasons.warnings(self.recording, self.analysis, self.about_links, self.tracking)

    @cached_property
    def tracking(self) -> Tracking:
        """Robots that were not at their places."""
        return Tracking(self.recording, self.analysis)

    # --- what several metrics are made of ---------------------------------------------------------

    @cached_property
    def about_links(self) -> Mapping[str, Any]:
        return link_metrics.describe_links(self.recording)

    @cached_property
    def distance_errors(self) -> Floats:
        """(k, m) m: how far each edge was from its wanted distance; NaN where it does not count."""
        a = self.analysis
        errors: Floats = np.where(a.counts, a.distances - a.wanted, np.nan)
        return errors

    @cached_property
    def ages_ms(self) -> Floats:
        """Ages of the neighbours' states whenever the law used one, in the drive."""
        robots, end_s = self.recording.robots.values(), self.recording.end_s
        return np.concatenate([robot.status.ages_between(0.0, end_s) for robot in robots]) / 1e3

    @cached_property
    def ticks_us(self) -> Floats:
        """Durations of the agents' ticks; none in virtual time, where they take none."""
        ticks = np.concatenate([robot.status.tick_us for robot in self.recording.robots.values()])
        return ticks[:0] if self.recording.mode == "simulate" else ticks

    @cached_property
    def totals(self) -> Counter[str]:
        """What all agents counted."""
        totals: Counter[str] = Counter()
        for robot in self.recording.robots.values():
            totals.update(robot.status.totals())
        return totals


@dataclass(frozen=True, slots=True)
class Picture:
    """How a sweep shows a metric's median over the runs of a cell: as a heat map or a curve, and in print.

    Attributes:
        file: name of the heat map, without suffix.
        label: what the curve's axis says.
        heading: what the printed column says.
        unit: in which it is shown.
        scale: so many of it are one of the metric's own.
        digits: behind the point.
    """

    file: str
    label: str
    heading: str
    unit: str
    scale: float = 1.0
    digits: int = 1


@dataclass(frozen=True, slots=True)
class Column:
    """A metric in a sweep: a number for each run, in a column of ``results.csv``.

    Attributes:
        place: columns are in this order.
        name: of the column; empty: the metric's.
        summarised: whether a sweep's summary has quantiles of it.
        low_is_good: whether less is better; a run without the number counts as the worst.
        picture: None: it is not shown.
    """

    place: int
    name: str = ""
    summarised: bool = True
    low_is_good: bool = True
    picture: Picture | None = None


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric.

    Attributes:
        name: where it is in ``metrics.json``: `a.b` is `b` within `a`.
        meaning: one sentence.
        value: what ``metrics.json`` holds: null for None.
        title: in the report's table; empty: it is not there.
        unit: empty without one.
        optional: whether it is left out when it holds nothing.
        column: in a sweep; None: it is not there.
    """

    name: str
    meaning: str
    value: Callable[[Evidence], Any]
    title: str = ""
    unit: str = ""
    optional: bool = False
    column: Column | None = None


def compute(result: Evidence) -> dict[str, Any]:
    """The content of ``metrics.json``, in the order of `METRICS`."""
    found: dict[str, Any] = {}
    for metric in METRICS:
        value = metric.value(result)
        if metric.optional and not value:
            continue
        *groups, name = metric.name.split(".")
        inner = found
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[name] = value
    return found


def look_up(found: dict[str, Any], name: str) -> Any:
    """The value of a metric in the content of ``metrics.json``."""
    for key in name.split("."):
        found = found[key]
    return found


def columns() -> dict[str, tuple[Metric, Column]]:
    """The metrics that sweeps have a column of, by the column's name, in order."""
    placed = [(metric, metric.column) for metric in METRICS if metric.column is not None]
    placed.sort(key=lambda pair: pair[1].place)
    return {column.name or metric.name: (metric, column) for metric, column in placed}


def write(path: str | PathLike[str], metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``: the same metrics give the same bytes, which end in a newline.

    Raises:
        RecordingError: when it cannot be written.
    """
    text = json.dumps(metrics, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {error.strerror or error}") from error


# --- how they are computed ------------------------------------------------------------------------


def _rms(errors: Floats) -> float | None:
    finite = errors[np.isfinite(errors)]
    return number(float(np.sqrt(np.mean(finite**2)))) if finite.size else None


def _distance(closest: Approach | None) -> float | None:
    return None if closest is None else number(closest.distance_m)


def _final_tracking_error(result: Evidence) -> float | None:
    a = result.analysis
    return largest(np.where(a.away[-1], np.nan, norm(a.hands[-1] - a.desired[-1])))


def _changes(result: Evidence) -> list[dict[str, Any]]:
    return [
        {
            "t_s": number(change.t_s),
            "version": change.version,
            "note": change.note,
            "settled_after_s": number(after_s),
        }
        for change, after_s in result.analysis.changes
    ]


def _oracles(result: Evidence) -> dict[str, dict[str, Any]]:
    return {
        name: {
            "checked": violations is not None,
            "violations": len(violations or ()),
            "first": violations[0].message if violations else None,
        }
        for name, violations in result.violations.items()
    }


def _rejected(result: Evidence) -> dict[str, int]:
    start = "rejected."
    totals = sorted(result.totals.items())
    return {name.removeprefix(start): count for name, count in totals if name.startswith(start) and count}


def _total(name: str) -> Callable[[Evidence], int]:
    return lambda result: result.totals[name]


def _link(name: str) -> Callable[[Evidence], Any]:
    return lambda result: result.about_links[name]


_MESSAGES: Final = {
    "sent": "Hand states, counted once for every neighbour.",
    "received": "Hand states that agents accepted, also from robots nearby that are no neighbours.",
    "lost": "Gaps in their numbers: they did not arrive, or after a newer one, or the sender was dead.",
    "delayed": "Came more than two rounds after they were sent.",
    "duplicated": "Arrived more than once.",
    "corrupted": "Damaged on the way.",
    "rejected": "Malformed, out of order or from the future: dropped, without effect.",
}
MESSAGES: Final = tuple(_MESSAGES)

METRICS: tuple[Metric, ...] = (
    Metric("fleet", "Name of the fleet.", lambda r: r.fleet.fleet.name),
    Metric("law", "Law that it was driven by.", lambda r: law_name(r.fleet.control)),
    Metric("seed", "Seed of its draws.", lambda r: r.recording.seed),
    Metric("mode", "`run` (processes) or `simulate` (virtual time).", lambda r: r.recording.mode),
    Metric("robots", "Number of robots.", lambda r: len(r.fleet.robots)),
    Metric("edges", "Number of edges that were ever in force.", lambda r: len(r.analysis.edges)),
    Metric("rate_hz", "Rounds that an agent makes in a second.", lambda r: number(r.fleet.fleet.rate_hz)),
    Metric("duration_s", "How long the fleet drove.", lambda r: number(r.recording.end_s)),
    Metric(
        "min_distance_m.edge", "Least distance ever measured between two robots that share an edge.",
        lambda r: _distance(r.analysis.with_edge.closest), "Closest, robots with an edge", "m",
        column=Column(2, low_is_good=False),
    ),
    Metric(
        "min_distance_m.any", "Least distance ever measured between any two robots.",
        lambda r: _distance(r.analysis.closest),
        "Closest, any two robots", "m",
        column=Column(
            3, low_is_good=False, picture=Picture("least_distance", "distance", "closest", "m", digits=3)
        ),
    ),
    Metric(
        "settling_time_s", "Last time that any edge was more than 5 % off its distance.",
        lambda r: number(r.analysis.settling_s), "Settling time", "s",
        column=Column(1, picture=Picture("settling_time", "settling time", "settling", "s")),
    ),
    Metric(
        "tracking_settling_time_s",
        "Last time that any robot was off its place, by a quarter of the least distance of two places.",
        lambda r: number(last_there_s(r.analysis)), "All at their places after", "s",
    ),
    Metric("changes", "Changes of mission, each with its own settling time.", _changes),
    Metric(
        "final_distance_error_m", "At the end: the worst edge's distance against the wanted one.",
        lambda r: largest(np.abs(r.distance_errors[-1])), "Final distance error", "m", column=Column(5),
    ),
    Metric(
        "final_tracking_error_m",
        "At the end: how far the worst robot is from its place on the desired path.",
        _final_tracking_error, "Final tracking error", "m", column=Column(6),
    ),
    Metric(
        "rms_distance_error_m", "Root mean square over all edges of robots that are not gone, and all times.",
        lambda r: _rms(r.distance_errors), "RMS distance error", "m",
        column=Column(4, picture=Picture("rms_error", "error", "RMS", "mm", 1e3, 0)),
    ),
    *(
        Metric(f"messages.{name}", meaning, _total(name), f"Messages {name}")
        for name, meaning in _MESSAGES.items()
    ),
    Metric(
        "age_of_information_ms.p50", "How old a neighbour's state was when the law used it.",
        lambda r: percentile(r.ages_ms, 50), "Age of information, median", "ms",
        column=Column(7, "age_p50_ms", summarised=False),
    ),
    Metric(
        "age_of_information_ms.p99", "Of 100 ages, 99 are below this.",
        lambda r: percentile(r.ages_ms, 99), "Age of information, 99 %", "ms", column=Column(8, "age_p99_ms"),
    ),
    Metric(
        "age_of_information_ms.max", "The oldest state ever used.",
        lambda r: largest(r.ages_ms), "Age of information, greatest", "ms",
        column=Column(9, "age_max_ms", summarised=False),
    ),
    Metric(
        "tick.p50_us", "Time an agent needs for one round of its loop.",
        lambda r: percentile(r.ticks_us, 50), "Tick, median", "µs",
    ),
    Metric(
        "tick.p99_us", "Of 100 rounds, 99 take less than this.",
        lambda r: percentile(r.ticks_us, 99), "Tick, 99 %", "µs",
    ),
    Metric("tick.overruns", "Rounds that started too late and were skipped.", _total("overruns"), "Overruns"),
    Metric(
        "machine.late_robots",
        "Robots whose agents skipped many rounds by no doing of the fleet: their machine was too slow.",
        lambda r: sorted(lateness.late_robots(r.recording)),
    ),
    Metric(
        "overload_s", "How long the fleet drove at a lower rate, or slower: a machine was overloaded.",
        lambda r: number(lateness.slowed_s(r.recording)), optional=True,
    ),
    Metric("links", "Of each link: what was asked, what was done, what was measured.", _link("links")),
    Metric("injected", "What was done to messages on purpose, over all links.", _link("injected")),
    Metric("clock_offsets", "Neighbours' clocks as each robot estimates them.", _link("clock_offsets")),
    Metric("oracles", "What each oracle found.", _oracles),
    Metric(
        "verdict", "Whether the run passed, why not, and warnings.",
        lambda r: {"passed": r.passed, "reasons": list(r.reasons), "warnings": list(r.warnings)},
    ),
    Metric(
        "messages_rejected_by_reason", "Rejected messages, by reason, where there were any.", _rejected,
        optional=True,
    ),
)  # fmt: skip
"""In the order of ``metrics.json``."""
