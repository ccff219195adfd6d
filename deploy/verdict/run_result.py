"""A finished run and all that is made of its recording."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.metrics import Evidence


class RunResult(Evidence):
    """A finished run: recording in, analysis, metrics and verdict out, each made once, when first asked for.

    Asking raises `agent.formation.geometry.FormationError` when the fleet's formation cannot be resolved.
    """

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``, by `deploy.verdict.metrics.METRICS`."""
        return metrics.compute(self)
