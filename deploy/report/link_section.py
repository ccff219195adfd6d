"""The part of a report that is about links: what was asked and done, what was measured, and the proof."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.html import figure, shown, table

ROWS_MAX: Final = 40
"""Links in the table; of more, the worst."""
_CAPTION: Final = (
    "How old a neighbour's state was when the law used it, by its receiver's estimate: the band holds nine "
    "of ten links, the lines are those of the links that were oldest on average. Below, the share of all "
    "messages between neighbours that was lost on purpose. Above, the faults and when they held."
)
_COLUMNS: Final = (
    "#Lost", "#Delay mean / 95 % / max (ms)", "#Twice", "#Damaged", "#Overtook", "#Held", "#Sent",
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
        ("held", "were held back"),
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
        '<p class="soft">Lost to held: what receivers did on purpose. Received and missing: what they '
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
        *(shown(done[name]) for name in ("duplicated", "corrupted", "reordered", "held")),
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
