"""A run's report: the figures and one HTML page that needs nothing beside itself.

Import this module only where a report is wanted: it loads matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.runtime.version import handfast_version
from handfast.agent.supervision.state_machine import State
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.analysis.rounding import largest, number, percentile
from handfast.deploy.console.wording import robots
from handfast.deploy.faults.rules import lanes
from handfast.deploy.playback.page import embedded
from handfast.deploy.playback.scene import Track, scene
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.run_files import FLEET_FILE, RECORDING_FILE, REPORT_FILE
from handfast.deploy.report import figures, html, links
from handfast.deploy.report.html import CSS, bullets, figure, inside, shown, table
from handfast.deploy.report.trajectory_figure import silent_bodies
from handfast.deploy.report.whole_file import whole_file
from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.run_result import RunResult


def write_report(folder: Path, result: RunResult, formats: Sequence[str] = ()) -> Path:
    """Draws the figures, in `formats` besides PNG, and writes ``report.html`` into `folder`; returns the
    page's path.

    Raises:
        RecordingError: when something cannot be written.
    """
    pictures = figures.write_figures(folder, result, formats)
    path = folder / REPORT_FILE
    page = _page(result, {name: picture.read_bytes() for name, picture in pictures.items()}, folder)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def remove_report(folder: Path) -> None:
    """Removes the figures and the page, as far as they are there."""
    (folder / REPORT_FILE).unlink(missing_ok=True)
    figures.remove_figures(folder)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return ""  # the page does without


# --- words -----------------------------------------------------------------------------------


def advice(result: RunResult) -> list[str]:
    """What to try after a run that failed or has warnings: sentences (HTML, escaped)."""
    out: list[str] = []
    recording, found = result.recording, result.metrics
    more = [*_advice_apart(result.fleet, found), *links.advice(recording, found)]
    if result.passed:
        return more
    safe = result.analysis.safe_m
    least = found["min_distance_m"]
    ends = [robot.status.at(recording.end_s) for robot in recording.robots.values()]
    states = {end[0] for end in ends if end is not None}
    if (
        recording.reasons
        or recording.warnings
        or None in ends
        or states & {State.WAITING.value, State.READY.value}
    ):
        out.append(
            "Look first at what the processes said (the folder <code>logs</code> beside this page): a robot "
            "that is not there makes every other number worse."
        )
    if State.FAULT.value in states:
        out.append("A robot in state <em>fault</em> says why in the table of robots below.")
    if State.HOLDING.value in states:
        out.append(
            "A robot in state <em>holding</em> says why in the table of robots below: it has heard no "
            "neighbour for longer than <code>control.prediction_horizon_s</code>, no operator, or is outside "
            "the geofence."
        )
    if State.RELEASED.value in states:
        out.append(
            "A robot in state <em>released</em> was its operator's, who gives it back by the mode GUIDED, "
            "armed; then <code>handfast resume</code> lets it drive on."
        )
    if least["edge"] is not None and least["edge"] < safe:
        if found["law"] == "paper":
            out.append(
                "The published law (<code>paper</code>) does not keep robots with several edges apart, as "
                "<code>docs/theory.md</code> shows: try <code>--law joint</code>."
            )
        else:
            out.append(
                "Robots with an edge came too close: check that they start further apart than the safe "
                "distance (<code>handfast check</code>) and that the plants can follow (limits, lag)."
            )
    out += more
    if found["settling_time_s"] is None and found["final_distance_error_m"] is not None:
        out.append(
            "If distances were still changing at the end, drive for longer (<code>--duration</code>). If "
            "they stood still off their marks, the formation is stuck in a wrong shape: try "
            "<code>--set formation.assign=true</code> or <code>--law joint</code>."
        )
    return out


def _advice_apart(fleet: Fleet, found: dict[str, Any]) -> list[str]:
    """For a pair without an edge that came too close."""
    least, safe = found["min_distance_m"], fleet.formation.safe_distance_m
    if least["any"] is None or least["any"] >= safe or least["any"] == least["edge"]:
        return []
    how = "" if fleet.avoidance.enabled else "turn on <code>avoidance.enabled</code>, "
    return [
        f"Two robots that share no edge came too close: {how}give them an edge, let "
        "<code>formation.assign = true</code> choose slots so that ways cross less, or start them elsewhere."
    ]


def _summary(result: RunResult) -> str:
    """What the verdict means, in plain words."""
    safe, found = result.analysis.safe_m, result.metrics
    if result.passed:
        settled, closest = found["settling_time_s"], result.analysis.closest
        if not found["edges"] or settled is None:
            what = "drove to the end"
        elif settled == 0:
            what = "was in formation all the time"
        else:
            what = f"was in formation after {settled:.1f} s and stayed so to the end"
        apart = ""
        if closest is not None:
            apart = (
                f" No two robots came closer than {closest.distance_m:.3f} m (robots {closest.pair[0]} and "
                f"{closest.pair[1]}); {safe:g} m is the least allowed."
            )
        return f"The fleet {what}.{apart}"
    count = len(result.reasons)
    return f"{'One thing is not as it' if count == 1 else f'{count} things are not as they'} should be:"


_FAULTS_ABOVE: Final = " Above it, what was made to fail on purpose, and when."
_PLAYER: Final = (
    "The drive from above, at any moment: press play, drag along the line, click on a robot, on a curve, on "
    "what happened. <code>handfast view</code> shows the same in full."
)
_CAPTIONS: Final = {
    "trajectories": "Paths of the hand points (solid) and the desired ones (dotted), with the robot's number "
    "at both ends and an arrow for its heading at the last. Circles have half the safe distance: two that "
    "touch are at the safe distance. The formation is drawn with its edges at the times written beside it. "
    "After the paper's Fig. 3.",
    "distances": "Distance of every pair of robots that share an edge, and of pairs without one that came "
    "near. No line may touch the red one; edges must end in the green band. After the paper's Fig. 4.",
    "forces": "What drives the robots: the navigation force pulls each along its path, the constraint force "
    "keeps the distances. Below, what the agents ask of their plants.",
    "timing": "How old the neighbours' states were when used; above it, where processes ran and not virtual "
    "time, how long the agents' rounds took.",
}


# --- page ------------------------------------------------------------------------------------


def _page(result: RunResult, pictures: dict[str, bytes], folder: Path) -> str:
    recording, fleet, found = result.recording, result.fleet, result.metrics
    toml = recording.fleet_toml or _text_of(folder / FLEET_FILE)
    name = escape(fleet.fleet.name)
    verdict = "passed" if result.passed else "failed"
    reasons = bullets([escape(reason) for reason in result.reasons])
    cautions = bullets([f"Warning: {escape(warning)}" for warning in result.warnings])
    tips = advice(result)
    failing = _FAULTS_ABOVE if lanes(recording, recording.end_s) else ""
    parts = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{name}: {verdict}</title>\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n<h1>{name}</h1>",
        f'<p class="soft">{escape(fleet.fleet.description)}</p>' if fleet.fleet.description else "",
        f"<p>{_what(recording, found)}</p>",
        f'<section class="verdict {verdict}">\n<h2>{verdict.capitalize()}</h2>\n'
        f"<p>{_summary(result)}</p>\n{reasons}{cautions}"
        + (f"<p><strong>What to try</strong></p>{bullets(tips)}" if tips else "")
        + "</section>",
        inside("The drive, played", _player(result), _PLAYER),
        _figures(pictures, "trajectories"),
        _figures(pictures, "distances", more=failing),
        "<h2>In numbers</h2>",
        _metrics_table(found),
        "<h2>Robots</h2>",
        _robots_table(recording, result.analysis),
        _silent_table(recording),
        html.section(recording, found),
        links.section(recording, found, pictures.get(links.NAME)),
        "<h2>Forces and timing</h2>" if {"forces", "timing"} & set(pictures) else "",
        _figures(pictures, "forces", "timing"),
        "<h2>Do it again</h2>",
        _again(recording, found),
        "<h2>Fleet file</h2>",
        f"<pre>{escape(toml)}</pre>"
        if toml
        else f"<p>It is beside this page: <code>{FLEET_FILE}</code>.</p>",
        f'<p class="soft">handfast {escape(handfast_version())}. Every message of the run is in '
        f"<code>{RECORDING_FILE}</code>, which Foxglove opens.</p>",
        "</body>\n</html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _figures(pictures: Mapping[str, bytes], *names: str, more: str = "") -> str:
    """Those of the pictures that there are, with their captions."""
    return "\n".join(
        figure(name, pictures[name], _CAPTIONS[name] + more) for name in names if name in pictures
    )


def _player(result: RunResult) -> str:
    track = Track(result)
    return embedded(scene(result, track), track.overview())


def _what(recording: Recording, found: dict[str, Any]) -> str:
    how = "in virtual time" if found["mode"] == "simulate" else "one process per agent and per plant"
    when = ""
    if found["mode"] == "run" and recording.epoch_ns is not None:
        # From the recording, not from a clock: a rebuilt report is the same page.
        when = f", started {datetime.fromtimestamp(recording.epoch_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    return (
        f"{found['robots']} robots and {found['edges']} edges, law <code>{escape(found['law'])}</code>, "
        f"{found['rate_hz']:g} Hz, {found['duration_s']:g} s, seed {found['seed']}, {how}{when}."
    )


def _metrics_table(found: dict[str, Any]) -> str:
    titled = [metric for metric in metrics.METRICS if metric.title]
    titled.sort(key=lambda metric: metric.name.startswith("messages."))  # counts last
    rows = [
        (metric.title, shown(metrics.look_up(found, metric.name), metric.unit), metric.meaning)
        for metric in titled
    ]
    for reason, count in found.get("messages_rejected_by_reason", {}).items():
        rows.append((f"Rejected: {escape(reason)}", shown(count), ""))
    return table(("Metric", "#Value", "Meaning"), rows)


def _robots_table(recording: Recording, a: Analysis) -> str:
    columns = (
        "#Robot", "State at the end", "#Closest (m)", "#Worst edge at the end (m)",
        "#Off its place at the end (m)",
        "#Tick 99 % (µs)", "#Overruns", "#Age 99 % (ms)", "#Sent", "#Received", "#Lost", "#Rejected",
    )  # fmt: skip
    rows = []
    for index, (robot, data) in enumerate(recording.robots.items()):
        totals = data.status.totals()
        state = data.status.at(recording.end_s)
        words = "nothing heard" if state is None else f"{state[0]}: {state[1]}" if state[1] else state[0]
        cells = (
            _closest(a, index),
            _worst_edge(a, index),
            number(np.hypot(*(a.hands[-1, index] - a.desired[-1, index]))),
            percentile(data.status.tick_us, 99) if recording.mode != "simulate" else None,
            totals.get("overruns"),
            percentile(data.status.ages_us / 1e3, 99),
            *(totals.get(name) for name in ("sent", "received", "lost", "rejected")),
        )
        rows.append((robot, escape(words), *map(shown, cells)))
    return table(columns, rows)


def _silent_table(recording: Recording) -> str:
    """Robots that were not heard at the end, and where the others believe them to be."""
    bodies = silent_bodies(recording)
    if not bodies:
        return ""
    rows = [
        (
            body.robot,
            body.how_long if body.silent_s is None else shown(body.silent_s),
            body.where,
            escape(robots(body.told_by)) if body.told_by else "&ndash;",
            "by the operator" if body.heard else "by nobody",
        )
        for body in bodies
    ]
    columns = ("#Robot", "#Silent (s)", "Believed (m)", "Not heard by", "Heard")
    return f"<h2>Robots that are not heard</h2>\n{table(columns, rows)}"


def _closest(a: Analysis, index: int) -> float | None:
    """Least distance of one robot from any other, ever."""
    others = np.delete(a.hands, index, axis=1) - a.hands[:, index : index + 1]
    lengths = np.hypot(others[..., 0], others[..., 1])
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.min()) if lengths.size else None


def _worst_edge(a: Analysis, index: int) -> float | None:
    own = (a.edges == index).any(axis=1) & a.counts[-1]
    return largest(np.abs(a.distances[-1, own] - a.wanted[-1, own]))


def _again(recording: Recording, found: dict[str, Any]) -> str:
    file = FLEET_FILE
    same = f"handfast {'simulate' if found['mode'] == 'simulate' else 'run'} {file} --seed {found['seed']}"
    lines = [(same, "this run again, from the file below, which holds every setting"),
             (f"handfast simulate {file} --seed {found['seed']}", "the same in virtual time"),
             ("handfast report .", "this page again, from the recording"),
             ("handfast export . --format csv", "the data as tables")]  # fmt: skip
    if found["mode"] == "simulate":
        del lines[1]
    width = max(len(command) for command, _ in lines)
    text = "\n".join(f"{command.ljust(width)}  # {what}" for command, what in lines)
    return f"<p>In the folder of this page:</p>\n<pre>{escape(text)}</pre>"
