"""When which rule of faults held in a run, a lane for each: for figures and players."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handfast.deploy.faults.windows import spans
from handfast.deploy.faults.wording import defaults, words
from handfast.deploy.recording.recording import Recording


@dataclass(frozen=True)
class Lane:
    """What a rule is called and does, and when it held (s of fleet time)."""

    text: str
    times: Sequence[tuple[float, float]]


def lanes(recording: Recording, end_s: float) -> list[Lane]:
    """One lane for each rule, in the order in which they begin; before them what holds everywhere."""
    times: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for span in spans(recording, end_s):
        name = f"{span.rule.name} ({span.author})" if span.author else span.rule.name
        times.setdefault((name, words(span.rule), span.author), []).append((span.start_s, span.end_s))
    ordered = sorted(times.items(), key=lambda item: min(item[1]))
    found = [Lane(f"{name}: {text}", each) for (name, text, _), each in ordered]
    everywhere = defaults(recording.fleet.faults)
    if everywhere is not None:
        found.insert(0, Lane(f"{everywhere.name}: {words(everywhere)}", [(0.0, end_s)]))
    return found
