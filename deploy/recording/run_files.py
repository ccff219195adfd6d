"""Names of the files in a run's folder, and what can go wrong with them."""

from __future__ import annotations

import errno
import os
from typing import Final

from handfast.agent.common.errors import Error

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


class RecordingError(Error):
    """A recording that cannot be written or read; the text is one line naming the file."""


def must_have_a_name(descriptor: int) -> None:
    """For who writes to an open file for long: nobody could read what is written to one that was removed.

    Raises:
        FileNotFoundError: it has no name any more.
    """
    if not os.fstat(descriptor).st_nlink:
        raise FileNotFoundError(errno.ENOENT, "it has been removed")
