"""What a finished run is judged by: its recording, and what is made of it once, when first asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import Geometry, resolve
from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict import link_metrics, oracles, reasons
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
        """Who was not at its place at the end."""
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
        """Of the neighbours' states, whenever the law used one.

        Before the start and after the end, neighbours come and go: ages from then say nothing of the drive.
        """
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
