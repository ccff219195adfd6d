"""The report's parts about oracles, changes of mission, and changes of the robots' states (HTML)."""

from __future__ import annotations

from html import escape
from typing import Any, Final

from handfast.deploy.recording.recording import Recording
from handfast.deploy.report.html import shown, table
from handfast.deploy.verdict.oracles import ORACLES

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
    rows = []
    for oracle in ORACLES:
        result = found["oracles"][oracle.name]
        count = result["violations"]
        words = "kept" if result["checked"] else "does not apply"
        if count:
            more = f" ({count - 1} more)" if count > 1 else ""
            words = f"<strong>violated</strong>: {escape(result['first'])}{more}"
        rows.append((oracle.name, escape(oracle.says), words))
    return table(("Rule", "What it says", "Result"), rows)


def _changes_table(found: dict[str, Any]) -> str:
    rows = [
        (shown(change["t_s"], "s"), escape(change["note"]), shown(change["settled_after_s"], "s"))
        for change in found["changes"]
    ]
    return table(("#From", "Change", "#In formation after"), rows)


def _transitions(recording: Recording) -> list[str]:
    changes = sorted(
        (change.t_s, robot, change)
        for robot, data in recording.robots.items()
        for change in data.status.changes()
    )
    rows = [
        (f"{t_s:.2f} s", robot, *map(escape, (change.before, change.state, change.row, change.reason)))
        for t_s, robot, change in changes[:TRANSITIONS_MAX]
    ]
    more = len(changes) - len(rows)
    columns = ("#Time", "#Robot", "From", "To", "Transition", "Why")
    return [table(columns, rows), *([f"<p>And {more} more.</p>"] if more else [])]
