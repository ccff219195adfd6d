"""The links of a run in a report: the figure of message ages, and tables of injected and measured faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from math import inf
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from handfast.agent.formation.points import Floats
from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.fault_strip import time_axes
from handfast.deploy.report.html import figure, shown, table
from handfast.deploy.report.layout import EndLabel, GridLayout, label_ends
from handfast.deploy.report.plotting import GREY, PALETTE, RED, new_figure, note, nth_marked
from handfast.deploy.verdict.link_metrics import Ages, ages
from handfast.deploy.verdict.run_result import RunResult

NAME: Final = "links"
PERIODS_OLD: Final = 2.0
"""Older information than this many periods, in more than one of a hundred cases, is worth a picture."""
WORST: Final = 4
"""Links that are drawn one by one."""
GAP_S: Final = 1.5
"""A link of which nothing is told for so long is none then: robots tell of theirs more than once a second."""
_BINS: Final = 150
_PLOT_IN: Final = 3.0
"""The axes of the ages are at least so high, inches."""


def worth_drawing(result: RunResult) -> bool:
    """Whether something was done to messages, or they were old without."""
    if len(result.recording.links):
        return True
    old_ms = 1e3 * PERIODS_OLD / result.fleet.fleet.rate_hz
    return bool(result.ages_ms.size) and float(np.percentile(result.ages_ms, 99)) > old_ms


def links(result: RunResult) -> Figure:
    """Age of information over time, of all links and of the worst; below it the share of messages lost."""
    recording = result.recording
    end = max(recording.end_s, 1e-3)
    lost = _lost(recording, end)
    figure = new_figure(7.6, 4.2 if lost is None else 5.4, GridLayout())
    age_axes, *below = time_axes(figure, recording, end, (1.0,) if lost is None else (3.0, 1.0))
    if lost is not None:
        _draw_lost(below[0], *lost)
    age = ages(recording)
    age_axes.set_ylabel("age of information (s)")
    if not age:
        note(age_axes, "no ages were recorded")
        return figure
    top, labels = _draw_ages(age_axes, age, end)
    horizon = recording.fleet.control.prediction_horizon_s
    if top > 0.45 * horizon:
        age_axes.axhline(horizon, color=RED, linewidth=1.2, linestyle=(0, (5, 3)))
        labels.insert(0, EndLabel("prediction horizon:\nbeyond it no edge\nis relied on", end, horizon, RED))
        top = max(top, horizon)
    age_axes.set_ylim(0.0, 1.1 * top)
    label_ends(age_axes, labels, _PLOT_IN)
    handles, names = age_axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, names, loc="outside upper left", ncols=4)
    return figure


def _draw_ages(axes: Axes, age: Ages, end: float) -> tuple[float, list[EndLabel]]:
    """Bands of all links, lines of the worst; the greatest age, s, and the names of these lines."""
    bins = np.linspace(0.0, end, _BINS + 1)
    middle = 0.5 * (bins[1:] + bins[:-1])
    table = np.full((len(age), _BINS), np.nan)
    for row, (t, values_ms) in enumerate(age.values()):
        inside = (t >= 0.0) & (t < end)
        which = np.clip(np.searchsorted(bins, t[inside], side="right") - 1, 0, _BINS - 1)
        greatest = np.full(_BINS, -np.inf)
        np.maximum.at(greatest, which, values_ms[inside] / 1e3)
        table[row] = np.where(np.isfinite(greatest), greatest, np.nan)
    known = np.isfinite(table).any(axis=0)
    middle, table = middle[known], table[:, known]
    if not len(middle):
        note(axes, "no ages were recorded during the drive")
        return 1.0, []
    few = len(age) <= WORST
    if not few:
        low, half, high = np.nanpercentile(table, (5, 50, 95), axis=0)
        color = PALETTE[2]
        axes.fill_between(
            middle, low, high, color=color, alpha=0.25, linewidth=0, label=f"90 % of {len(age)} links"
        )
        axes.plot(middle, half, color=color, linewidth=1.5, label="median link")
    names = list(age)
    worst = np.argsort([-float(values_ms.mean()) for _, values_ms in age.values()], kind="stable")[:WORST]
    labels = []
    # The best of them first: the worst lies on top, and its colour is the strongest.
    for place, row in reversed(list(enumerate(worst.tolist()))):
        source, destination = names[row]
        t, values_ms = age[source, destination]
        inside = (t >= 0.0) & (t <= end)
        if not inside.any():
            continue
        t, values = _with_gaps(t[inside], values_ms[inside] / 1e3)
        style = nth_marked(place, len(t)) | {"color": _LINES[place]}
        axes.plot(t, values, linewidth=0.8, alpha=0.9, **style)
        ends = float(t[-1]), float(values[-1])
        labels.append(EndLabel(f"{source}→{destination}", *ends, _LINES[place], style["marker"]))
    return float(np.nanmax(table)), labels[::-1]


def _with_gaps(t: Floats, values: Floats) -> tuple[Floats, Floats]:
    """With a break wherever nothing was told of the link for long: it was none then."""
    gaps = np.flatnonzero(np.diff(t) > GAP_S) + 1
    return np.insert(t, gaps, t[gaps - 1]), np.insert(values, gaps, np.nan)


_LINES: Final = (PALETTE[1], PALETTE[0], PALETTE[3], PALETTE[7])


def _lost(recording: Recording, end: float) -> tuple[Floats, Floats] | None:
    """Edges of bins (s) and the share of messages between neighbours that was lost on purpose in each, %.

    Both are counted as they were: who sends seldom, or not at all, loses little."""
    rows = recording.links
    rows = rows[rows.lost & (rows.topic == 0) & (rows.t >= 0.0) & (rows.t <= end)]
    bins = np.linspace(0.0, end, max(int(min(end / 0.5, _BINS)), 1) + 1)
    gone, sent = np.zeros(len(bins) - 1), np.zeros(len(bins) - 1)
    begins, graphs = _graphs(recording)
    for since, until, graph in zip(begins, [*begins[1:], inf], graphs, strict=True):
        then = rows[(rows.t >= since) & (rows.t < until)]
        links = graph | {(j, i) for i, j in graph}
        pairs = zip(then.source.tolist(), then.destination.tolist(), strict=True)
        are_links = np.fromiter((pair in links for pair in pairs), np.bool_, len(then))
        gone += np.histogram(then.t[are_links], bins)[0]
        for source, neighbours in Counter(i for i, _ in links).items():
            t = recording.robots[source].hand.t
            sent += neighbours * np.histogram(t[(t >= since) & (t < until)], bins)[0]
    return (bins, np.minimum(100.0 * gone / np.maximum(sent, 1.0), 100.0)) if gone.any() else None


def _graphs(recording: Recording) -> tuple[list[float], list[set[tuple[int, int]]]]:
    """The edges of the missions one after the other, and from when (fleet time, s) on each holds."""
    begins, graphs = [-inf], [set(recording.fleet.formation.edges)]
    for mission in recording.held_missions:
        if mission.robots:
            begins.append(recording.fleet_time_s(mission.from_ns))
            graphs.append({(i, j) for i, j, _ in mission.edges})
    return begins, graphs


def _draw_lost(axes: Axes, bins: Floats, share: Floats) -> None:
    axes.stairs(share, bins, fill=True, color=GREY, alpha=0.55)
    axes.set_ylabel("lost on\npurpose (%)")
    axes.set_ylim(0.0, max(1.15 * float(share.max()), 1.0))


ROWS_MAX: Final = 40
"""Links in the table; of more, the worst."""
_CAPTION: Final = (
    "How old a neighbour's state was when the law used it, by its receiver's estimate: the band holds nine "
    "of ten links, the lines are those of the links that were oldest on average. Below, the share of all "
    "messages between neighbours that was lost on purpose. Above, the faults and when they held."
)
_COLUMNS: Final = (
    "#Lost", "#Delay mean / 95 % / max (ms)", "#Twice", "#Damaged", "#Overtook", "#Sent",
    "#Received", "#Missing", "#Age 50 % / 99 % (ms)",
)  # fmt: skip


def section(recording: Recording, found: Mapping[str, Any], picture: bytes | None) -> str:
    """The section (HTML); empty when nothing was done to links and no picture was drawn.

    found: the run's metrics.
    """
    links = found["links"]
    if not links and picture is None:
        return ""
    parts = ["<h2>Links</h2>"]
    if links:
        parts.append(f"<p>{_total(found['injected'])}</p>")
    clocks = _clocks(found["clock_offsets"])
    if clocks:
        parts.append(f"<p>{clocks}</p>")
    if picture is not None:
        parts.append(figure("links", picture, _CAPTION))
    if links:
        parts.append(_links_table(links))
    return "\n".join(parts)


def _total(injected: Mapping[str, Any]) -> str:
    parts = [f"{shown(injected['lost'])} were lost ({100 * (injected['rate'] or 0.0):.1f} %)"]
    for name, said in (
        ("duplicated", "came twice"), ("corrupted", "were damaged"), ("reordered", "overtook others"),
    ):  # fmt: skip
        if injected[name]:
            parts.append(f"{shown(injected[name])} {said}")
    delay = injected["delay_ms"]
    if delay["max"]:
        parts.append(
            f"the others were made to wait {delay['mean']:.1f} ms on average, {delay['max']:.0f} at most"
        )
    text = f"Of {shown(injected['decided'])} messages under fault rules, beacons left out, "
    return text + _series(parts) + "."


def _series(parts: Sequence[str]) -> str:
    return ", ".join(parts[:-1]) + (" and " if len(parts) > 1 else "") + parts[-1]


def _clocks(offsets: Sequence[Mapping[str, Any]]) -> str:
    known = [entry for entry in offsets if abs(entry["offset_ms"]) > entry["error_ms"]]
    if not known:
        return ""
    worst = max(known, key=lambda entry: (abs(entry["offset_ms"]), -entry["robot"], -entry["neighbour"]))
    way = "ahead of" if worst["offset_ms"] > 0 else "behind"
    return (
        f"Clocks differ: at the end robot {worst['neighbour']}'s was {abs(worst['offset_ms']):.1f} ms {way} "
        f"robot {worst['robot']}'s, within {worst['error_ms']:.1f} ms, as their messages tell."
    )


def _links_table(links: Sequence[Mapping[str, Any]]) -> str:
    chosen = list(links)
    note = ""
    if len(chosen) > ROWS_MAX:
        chosen = sorted(chosen, key=_badness)[:ROWS_MAX]
        order = {id(link): place for place, link in enumerate(links)}
        chosen.sort(key=lambda link: order[id(link)])
        note = (
            f'<p class="soft">The worst {ROWS_MAX} of {len(links)} links, by age and loss; all are in '
            "<code>metrics.json</code>.</p>"
        )
    note += (
        '<p class="soft">Lost to reordered: what receivers did on purpose. Received and missing: what they '
        "counted during the drive; a message that a newer one overtook is missing, and so is each that a "
        "sender would have sent while it was dead.</p>"
    )
    asked = {link["asked"] for link in chosen}
    one = f"<p>Asked of every link: <code>{escape(next(iter(asked)))}</code>.</p>" if len(asked) == 1 else ""
    columns = ("Link", *_COLUMNS) if one else ("Link", "Asked", *_COLUMNS)
    rows = [_row(link, asked_too=not one) for link in chosen]
    return f"{one}{table(columns, rows)}{note}"


def _badness(link: Mapping[str, Any]) -> tuple[float, float]:
    """For sorting, the worst first."""
    age = link["age_ms"]
    return -(age["p99"] if age else 0.0), -(link["injected"]["rate"] or 0.0)


def _row(link: Mapping[str, Any], *, asked_too: bool) -> list[str]:
    done, measured, age = link["injected"], link["measured"], link["age_ms"]
    delay = done["delay_ms"]
    topic = "" if link["topic"] == "hand" else f" {link['topic']}"
    return [
        f"{link['link'].replace('->', '→')}{topic}",
        *([escape(link["asked"])] if asked_too else []),
        f"{100 * done['rate']:.1f} %" if done["rate"] is not None else "–",
        _slashed(delay["mean"], delay["p95"], delay["max"]),
        *(shown(done[name]) for name in ("duplicated", "corrupted", "reordered")),
        *(shown(measured[name]) for name in ("sent", "received", "lost")),
        _slashed(age["p50"], age["p99"]) if age else "–",
    ]


def _slashed(*values: float | None) -> str:
    return " / ".join("–" if value is None else f"{value:.0f}" for value in values)


def advice(recording: Recording, found: Mapping[str, Any]) -> list[str]:
    """What to try about links: sentences (HTML, escaped)."""
    out = []
    control = recording.fleet.control
    oldest_ms = found["age_of_information_ms"]["max"] or 0.0
    late = (found["age_of_information_ms"]["p99"] or 0.0) > 2e3 / recording.fleet.fleet.rate_hz
    if late and not control.prediction:
        out.append(
            "Neighbours' states were old and prediction is off: <code>--set control.prediction=true</code> "
            "carries them forward over their age."
        )
    if found["links"] and oldest_ms > 1e3 * control.prediction_horizon_s:
        out.append(
            f"A neighbour's state was {oldest_ms / 1e3:.1f} s old, more than "
            f"<code>control.prediction_horizon_s</code> = {control.prediction_horizon_s:g} s: robots hold "
            "then. Let links fail for less long, or raise it and see whether distances stay safe."
        )
    ends = [robot.status.at(recording.end_s) for robot in recording.robots.values()]
    own = {link["topic"] for link in found["links"]} & {"state", "wrench"}
    if own and any(end is not None and end[0] == State.FAULT.value for end in ends):
        out.append(
            "Links between agents and their own plants were made to fail. An agent that waits for its plant "
            f"longer than <code>control.plant_timeout_s</code> = {control.plant_timeout_s:g} s is in "
            f"<em>fault</em>, and a plant without a wrench for <code>control.wrench_timeout_s</code> = "
            f"{control.wrench_timeout_s:g} s brakes."
        )
    return out
