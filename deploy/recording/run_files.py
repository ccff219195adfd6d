"""Names of the files in a run's folder."""

from __future__ import annotations

from typing import Final

FLEET_FILE: Final = "fleet.toml"
"""The fleet as it was driven, every setting spelled out."""
RECORDING_FILE: Final = "run.mcap"
"""Every message of the run (MCAP)."""
METRICS_FILE: Final = "metrics.json"
EVENTS_FILE: Final = "events.txt"
"""What happened and when, line by line."""
REPORT_FILE: Final = "report.html"
LOG_FOLDER: Final = "logs"
"""Holds one log for each process."""
