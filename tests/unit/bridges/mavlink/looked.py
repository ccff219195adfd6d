"""A simulated rover that has told all about itself, and what preflight says of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.ardupilot import frames
from handfast.bridges.mavlink.bridge import preflight_checks
from handfast.bridges.mavlink.bridge.preflight_checks import BridgeState, Look
from handfast.plant.backend import Check
from tests.rover_scene import Scene

SAFE = {"FS_GCS_ENABLE": 1.0, "FS_CRASH_CHECK": 1.0, "BATT_FS_LOW_ACT": 2.0}
"""What differs from ArduPilot's defaults where all is on that can be."""


class Looked:
    """A rover that has told all about itself; `line` reads the table with some of it otherwise."""

    def __init__(self, *overrides: str, seconds: float = 7.0, **settings: Any) -> None:
        self.scene = Scene(*overrides, **settings)
        self.scene.run(seconds)
        self.link = self.scene.bridge.link
        self.section = self.scene.fleet.robot(1).section(MavlinkSection) or MavlinkSection()
        self.found = BridgeState(
            self.scene.now_ns, "", "", seconds, 0.02, "", self.scene.bridge.reading.pose, (-3.0, 4.2), ""
        )

    def lines(self, **found: Any) -> Sequence[Check]:
        state = self.found._replace(**found)
        return preflight_checks.checks(
            Look(self.link, state, self.section, frames.datum_of(self.scene.fleet))
        )

    def line(self, name: str, **found: Any) -> Check:
        lines = self.lines(**found)
        named = [line for line in lines if line.name == name]
        assert len(named) == 1, lines
        return named[0]

    def names(self) -> list[str]:
        return [line.name for line in self.lines()]
