"""Parts of a report's page (HTML, self-contained): oracles, changes of mission, and changes of state."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, Final

from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.oracles import ORACLES

CSS: Final = """
:root {
  color-scheme: light dark;
  --ink: #1d1d1f; --soft: #62666d; --page: #fbfbfa; --card: #fff; --line: #dfe1e5;
  --good: #00664b; --bad: #b3121d; --good-bg: #e6f4ef; --bad-bg: #fcebec;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ink: #e8e8ea; --soft: #a2a6ae; --page: #16171a; --card: #1f2125; --line: #383b42;
    --good: #5fd3a9; --bad: #ff8a8f; --good-bg: #12312a; --bad-bg: #3a1a1d;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; padding: 1.5rem; max-width: 62rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif;
}
h1 { font-size: 1.6rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p { margin: .4rem 0; }
.soft { color: var(--soft); }
.verdict { border-left: .4rem solid; border-radius: .3rem; padding: .8rem 1.1rem; margin: 1.2rem 0; }
.verdict h2 { margin: 0 0 .2rem; }
.verdict ul { margin: .4rem 0; padding-left: 1.3rem; }
.passed { border-color: var(--good); background: var(--good-bg); }
.passed h2 { color: var(--good); }
.failed { border-color: var(--bad); background: var(--bad-bg); }
.failed h2 { color: var(--bad); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; background: var(--card); font-size: .88rem; }
th, td { border-bottom: 1px solid var(--line); padding: .3rem .6rem; text-align: left; vertical-align: top; }
th { font-weight: 600; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; }
figure { margin: 0 0 1.6rem; }
figcaption { font-size: .9rem; color: var(--soft); margin-top: .4rem; }
img {
  display: block; max-width: 100%; max-height: 52rem; height: auto; margin: 0 auto; padding: .5rem;
  background: #fff; border: 1px solid var(--line); border-radius: .3rem;
}
iframe { display: block; width: 100%; height: 42rem; border: 1px solid var(--line); border-radius: .3rem; }
pre {
  background: var(--card); border: 1px solid var(--line); border-radius: .3rem; padding: .7rem;
  overflow-x: auto; font: .8rem/1.45 ui-monospace, "DejaVu Sans Mono", monospace;
}
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .92em; }
@media print {
  iframe { display: none; }
  body { max-width: none; padding: 0; font-size: 11pt; }
  figure, tr, .verdict { break-inside: avoid; }
  h2 { break-after: avoid; }
  pre { white-space: pre-wrap; }
}
"""


def bullets(items: Sequence[str]) -> str:
    """A list of items (HTML), empty without any."""
    return "<ul>\n" + "\n".join(f"<li>{item}</li>" for item in items) + "\n</ul>\n" if items else ""


def figure(name: str, picture: bytes, caption: str) -> str:
    """A picture (PNG) inside the page, with its caption (plain text)."""
    data = base64.b64encode(picture).decode()
    words = escape(caption)
    return (
        f'<figure>\n<img alt="{escape(name.capitalize())}: {words}" src="data:image/png;base64,{data}">\n'
        f"<figcaption>{words}</figcaption>\n</figure>"
    )


def inside(title: str, page: str, caption: str) -> str:
    """Another page (HTML) inside the page, with its caption (HTML).

    Its styles and names are its own, and its scripts cannot reach what is outside.
    """
    text = page.replace("&", "&amp;").replace("'", "&#39;")
    return (
        f'<figure>\n<iframe title="{escape(title)}" sandbox="allow-scripts" srcdoc=\'{text}\'></iframe>\n'
        f"<figcaption>{caption}</figcaption>\n</figure>"
    )


def shown(value: Any, unit: str = "") -> str:
    """A number with its unit; a dash for None."""
    if value is None:
        return "–"
    whole = isinstance(value, int) or abs(value) >= 1000
    text = f"{value:,.0f}" if whole else f"{value:.4g}"
    return f"{text} {unit}".strip()


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table of HTML that scrolls sideways on its own; "#" begins the name of a column of numbers."""
    kinds = [' class="n"' if name.startswith("#") else "" for name in columns]

    def row(tag: str, cells: Sequence[object]) -> str:
        parts = (f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))
        return f"<tr>{''.join(parts)}</tr>"

    head = row("th", [name.removeprefix("#") for name in columns])
    body = "\n".join(row("td", cells) for cells in rows)
    return f'<div class="scroll"><table>\n<thead>{head}</thead>\n<tbody>\n{body}\n</tbody></table></div>'


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
