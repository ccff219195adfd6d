"""A recorded run's fates as a scenario: every message, by its link and number, suffers the same again."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from typing import Any, Final

import numpy as np
import tomli_w

from agent.impairments.recorded_fates import DELAY_US_MAX, FATES_MAX, UNTOUCHED, encode_fates
from agent.impairments.recorded_fates import LOST as FATE_LOST
from agent.messages.sequence_numbers import FIRST_ROUND
from agent.messages.types import CORRUPTED, LOST
from deploy.recording.link_table import Ints, LinkTable
from deploy.recording.links import Link
from deploy.recording.mcap_reader import read_run
from deploy.recording.recorder import RecordingError

_ROUNDS_BEFORE: Final = FIRST_ROUND // 2
"""Lesser numbers are from before the mission was known: they count from 0, and the next run begins anew."""


def write_scenario(folder: str | PathLike[str]) -> str:
    """The text (TOML) of a scenario that gives every message of the run in `folder` the same fate again.

    It has one ``[[faults.replay]]`` for each link on which something was decided. What came damaged is
    lost in it; what was held comes as late as it came.

    Raises:
        RecordingError: the run cannot be read, or nothing was done to its messages.
        FleetError: its fleet file is not valid.
    """
    recording = read_run(folder)
    tables = list(_tables(recording.links))
    if not tables:
        raise RecordingError(
            f"{folder} has no fates to replay: no fault rule held for any message after its mission was known"
        )
    head = (
        f"# What became of the messages of {_one_line(str(folder))} (fleet {recording.fleet.fleet.name},\n"
        f"# {recording.mode}, seed {recording.seed}). To be given again, by link and number.\n"
    )
    return head + tomli_w.dumps({"faults": {"replay": tables}})


def _one_line(text: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _tables(links: LinkTable) -> Iterator[dict[str, Any]]:
    for link, rows in links.by_link():
        table = _table(link, rows[rows.sequence >= _ROUNDS_BEFORE])
        if table is not None:
            yield table


def _table(link: Link, rows: LinkTable) -> dict[str, Any] | None:
    if not len(rows):
        return None
    # Of two messages with one number (a process was started again in between) the first counts.
    sequence = rows.sequence
    first, last = int(sequence.min()), int(sequence.max())
    if last - first >= FATES_MAX:
        last = first + FATES_MAX - 1
        rows = rows[sequence <= last]
    fate = np.where(rows.what & (LOST | CORRUPTED), FATE_LOST, np.minimum(rows.delay_us, DELAY_US_MAX))
    own = rows.first_copies
    table: dict[str, Any] = {
        "link": f"{link.source}->{link.destination}",
        "topic": link.topic,
        "first": first,
        "fates": encode_fates(_column(rows.sequence[own] - first, fate[own], last - first + 1)),
    }
    if not own.all():
        second = _column(rows.sequence[~own] - first, fate[~own], last - first + 1)
        table["second"] = encode_fates(second)
    return table


def _column(places: Ints, fates: Ints, size: int) -> list[int]:
    column = np.full(size, UNTOUCHED, dtype=np.int64)
    column[places[::-1]] = fates[::-1]
    fates_of: list[int] = column.tolist()
    return fates_of
