"""Made-up runs of three robots, whose every number is known."""

from __future__ import annotations

from handfast.agent.fleet.model import Fleet
from handfast.deploy.recording.collector import RunData
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.synthetic_run import Path, in_formation, make_fleet, messages, triangle

FLEET = make_fleet(*triangle(2), velocity=(0.5, 0.3), duration_s=3.0, rate_hz=20)


def result_of(fleet: Fleet = FLEET, paths: list[Path] | None = None, **more: str) -> RunResult:
    """A run in which bodies took these paths; those of the formation, unless given."""
    data = RunData(fleet)
    for sent in messages(fleet, in_formation(fleet) if paths is None else paths, **more):  # type: ignore[arg-type]
        data.feed(*sent)
    return RunResult(data.recording())
