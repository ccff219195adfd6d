"""The report's parts about oracles, changes of mission, and changes of the robots' states (HTML)."""

from __future__ import annotations

from html import escape
from typing import Any, Final

from deploy.recording.recording import Recording
from deploy.report.html import shown, table
from deploy.verdict.oracles import ORACLES

TRANSITIONS_MAX: Final = 400
"""Changes of state that are listed; of more, the first."""


def section(recording: Recording, found: dict[str, Any]) -> str:
    """The three tables with their headings (HTML); without changes of mission no table of those."""
    parts = ["<h2>What must always hold</h2>", _oracles_table(found)]
    if found["changes"]:
        parts += ["<h2>Changes of mission</h2>", _changes_table(found)]
    parts += ["<h2>States</h2>", *_transitions(recording)]
    return "\n".join(parts)


def _oracles_table(found: dict[str, Any]) -> str:
    head = "<tr><th>Rule</th><th>What it says</th><th>Result</th></tr>"
    rows = []
    for oracle in ORACLES:
        result = found["oracles"][oracle.name]
        count = result["violations"]
        words = "kept" if result["checked"] else "does not apply"
        if count:
            more = f" ({count - 1} more)" if count > 1 else ""
            words = f"<strong>violated</strong>: {escape(result['first'])}{more}"
        rows.append(f"<tr><td>{oracle.name}</td><td>{escape(oracle.says)}</td><td>{words}</td></tr>")
    return table(head, rows)


def _changes_table(found: dict[str, Any]) -> str:
    head = '<tr><th class="n">From</th><th>Change</th><th class="n">In formation after</th></tr>'
    rows = [
        f'<tr><td class="n">{shown(change["t_s"], "s")}</td><td>{escape(change["note"])}</td>'
        f'<td class="n">{shown(change["settled_after_s"], "s")}</td></tr>'
        for change in found["changes"]
    ]
    return table(head, rows)


def _transitions(recording: Recording) -> list[str]:
    head = (
        '<tr><th class="n">Time</th><th class="n">Robot</th><th>From</th><th>To</th><th>Transition</th>'
        "<th>Why</th></tr>"
    )
    changes = sorted(
        (change.t_s, robot, change)
        for robot, data in recording.robots.items()
        for change in data.status.changes()
    )
    rows = [
        f'<tr><td class="n">{t_s:.2f} s</td><td class="n">{robot}</td><td>{escape(change.before)}</td>'
        f"<td>{escape(change.state)}</td><td>{escape(change.row)}</td><td>{escape(change.reason)}</td></tr>"
        for t_s, robot, change in changes[:TRANSITIONS_MAX]
    ]
    more = len(changes) - len(rows)
    return [table(head, rows), *([f"<p>And {more} more.</p>"] if more else [])]
