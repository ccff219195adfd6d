"""A run for other programs: as tables (CSV, Parquet or JSON), or as a bag of ROS 2.

Of tables one file each, tidy: one row per robot (or edge) and time, units in the names of the columns. JSON
is an array of records, one on each line. What is not known (a robot that sent nothing), or not wanted
(an edge that was not in force), is empty in CSV, null elsewhere.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.errors import packages_named
from handfast.agent.messages.declaration import Field, declared
from handfast.agent.messages.types import (
    CORRUPTED,
    DUPLICATED,
    LOST,
    OVERFLOW,
    RANGE,
    REORDERED,
    TOPICS,
    HandState,
    Multiplier,
    PlantState,
    Wrench,
)
from handfast.deploy.analysis.analysis import Analysis
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.recording.tables import LinkTable, StatusTable, Table, columns
from handfast.deploy.report.whole_file import whole_files
from handfast.deploy.verdict.metrics import MESSAGES
from handfast.deploy.verdict.run_result import RunResult

BAG: Final = "rosbag2"
TABLES: Final = ("csv", "parquet", "json")
FILMS: Final = ("mp4", "gif")
"""Formats that `deploy.report.film` writes."""
FORMATS: Final = (*TABLES, BAG, *FILMS)
FOLDER: Final = "export"

Column = NDArray[Any] | list[str]
Columns = dict[str, Column]
Writer = Callable[[RunResult, Path], list[Path]]
"""Writes a run to a folder, made if need be; gives what it wrote there."""

_DTYPES: Final = {int: np.int64, float: np.float64, bool: np.bool_}
_NAMES: Final = {"value": "multiplier", "doubt": "position_uncertainty"}
_WHAT: Final = {
    "lost": LOST, "duplicated": DUPLICATED, "corrupted": CORRUPTED, "reordered": REORDERED,
    "range": RANGE, "overflow": OVERFLOW,
}  # fmt: skip
_COUNTS: Final = (*MESSAGES, "overruns")


def export(
    folder: str | PathLike[str],
    format: str,
    out: str | PathLike[str] | None = None,
    *,
    warn: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Write the run in `folder` to the folder `out` (its own ``export`` unless given): its tables, or, in a
    folder ``rosbag2`` there, a bag of ROS 2.

    Tables: ``hands``, ``plants``, ``wrenches``, ``multipliers``, ``statuses`` (one row per message),
    ``distances`` (one per edge and period of the fleet), ``links`` (one per decision of a fault rule) when
    there was one, and ``truths`` when plants measure with noise. All are there, or what was there before.

    Args:
        warn: told what of the recording could not be read, a line each.

    Raises:
        RecordingError: unknown format, not writable, or the run cannot be read; one line.
        MissingPackageError: no pyarrow, or no rosbags.
        FleetError: the run's fleet file is not valid.
    """
    if format not in (*TABLES, BAG):
        raise RecordingError(f"unknown format {format!r}; there are {', '.join(FORMATS)}")
    write = _bag_writer() if format == BAG else _tables_writer(format)
    recording = read_run(folder)
    for warning in recording.warnings:
        warn(warning)
    result = RunResult(recording)
    target = Path(folder) / FOLDER if out is None else Path(out)
    try:
        return write(result, target)
    except OSError as error:
        raise RecordingError(f"cannot write the export to {target}: {error.strerror or error}") from error


def tabulate(result: RunResult) -> dict[str, Columns]:
    """Every table by name, its columns by name, all columns of a table of one length."""
    recording = result.recording
    robots = recording.robots.values()
    tables = {
        "hands": _stack([(robot.id, robot.hand) for robot in robots], columns(HandState)),
        "plants": _stack([(robot.id, robot.plant) for robot in robots], columns(PlantState)),
        "wrenches": _stack([(robot.id, robot.wrench) for robot in robots], columns(Wrench)),
        "multipliers": _stack([(robot.id, robot.multipliers) for robot in robots], declared(Multiplier)),
        "distances": _distances(result.analysis),
        "statuses": _statuses([(robot.id, robot.status) for robot in robots]),
    }
    if len(recording.links):
        tables["links"] = _links(recording.links)
    if any(len(robot.truth) for robot in robots):
        tables["truths"] = _stack([(robot.id, robot.truth) for robot in robots], columns(PlantState))
    return tables


def _stack(parts: Sequence[tuple[int, Table]], fields: Sequence[Field]) -> Columns:
    out: Columns = {
        "t_s": np.concatenate([table.t for _, table in parts]),
        "robot": np.concatenate([np.full(len(table), robot, dtype=np.int64) for robot, table in parts]),
    }
    for field in fields:
        values = np.concatenate([table[field.name] for _, table in parts])
        out[named(field)] = values.astype(_DTYPES[field.kind])
    return out


def named(field: Field) -> str:
    """Name of a field's column: with its unit, ``speed_mps``."""
    unit = field.about.unit.replace("/", "p").replace(" ", "").lower()
    name = _NAMES.get(field.name, field.name)
    return name if not unit or name.endswith(f"_{unit}") else f"{name}_{unit}"


def _distances(a: Analysis) -> Columns:
    ids = np.array(a.ids, dtype=np.int64)
    times, edges = a.distances.shape
    return {
        "t_s": np.repeat(a.grid, edges),
        "edge_i": np.tile(ids[a.edges[:, 0]], times),
        "edge_j": np.tile(ids[a.edges[:, 1]], times),
        "distance_m": a.distances.ravel(),
        "wanted_m": a.wanted.ravel(),
    }


def _links(links: LinkTable) -> Columns:
    """What was done to messages, one row per decision; a delay of a lost message is not known."""
    topics = np.array(TOPICS)
    columns: Columns = {
        "t_s": links.t,
        "source": links.source,
        "destination": links.destination,
        "topic": [str(topic) for topic in topics[links.topic]],
        "sequence": links.sequence,
    }
    for name, bit in _WHAT.items():
        columns[name] = (links.what & bit) != 0
    columns["delay_s"] = np.where(links.delivered, links.delay_us / 1e6, np.nan)
    return columns


def _statuses(parts: Sequence[tuple[int, StatusTable]]) -> Columns:
    columns: Columns = {
        "t_s": np.concatenate([table.t for _, table in parts]),
        "robot": np.concatenate([np.full(len(table), robot, dtype=np.int64) for robot, table in parts]),
        "state": [state for _, table in parts for state in table.states],
        "transition": [row for _, table in parts for row in table.transitions],
        "reason": [reason for _, table in parts for reason in table.reasons],
        "mission_version": np.concatenate([table.mission_versions for _, table in parts]),
        "order_version": np.concatenate([table.order_versions for _, table in parts]),
    }
    for name in _COUNTS:
        columns[name] = np.array(
            [counters.get(name, 0) for _, table in parts for counters in table.counters], dtype=np.int64
        )
    columns["tick_max_us"] = np.concatenate([table.tick_max_us for _, table in parts])
    columns["age_max_us"] = np.concatenate([table.age_max_us for _, table in parts])
    return columns


# --- formats ---------------------------------------------------------------------------------


def _bag_writer() -> Writer:
    with packages_named(f"--format {BAG}"):
        from handfast.deploy.report.rosbag2 import write_bag

    def write(result: RunResult, target: Path) -> list[Path]:
        write_bag(result, target / BAG)
        return [target / BAG]

    return write


def _tables_writer(format: str) -> Writer:
    write_table = _table_writer(format)

    def write(result: RunResult, target: Path) -> list[Path]:
        tables = tabulate(result)
        paths = {target / f"{name}.{format}": table for name, table in tables.items()}
        target.mkdir(parents=True, exist_ok=True)
        with whole_files(list(paths)) as parts:
            for part, table in zip(parts, paths.values(), strict=True):
                write_table(part, table)
        return list(paths)

    return write


def _rows(columns: Columns) -> Iterable[tuple[Any, ...]]:
    """Rows of plain Python values, None for NaN."""
    lists: list[list[Any]] = []
    for column in columns.values():
        values = column if isinstance(column, list) else column.tolist()
        if not isinstance(column, list) and column.dtype.kind == "f" and np.isnan(column).any():
            values = [None if value != value else value for value in values]
        lists.append(values)
    return zip(*lists, strict=True)


def _write_csv(path: Path, columns: Columns) -> None:
    flags = [index for index, column in enumerate(columns.values()) if _is_flag(column)]
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        for row in _rows(columns):
            values = list(row)
            for index in flags:
                values[index] = "true" if values[index] else "false"
            writer.writerow(values)


def _is_flag(column: Column) -> bool:
    return not isinstance(column, list) and column.dtype == np.bool_


def _write_json(path: Path, columns: Columns) -> None:
    names = list(columns)
    with open(path, "w", encoding="utf-8") as stream:
        separator = "[\n"
        for row in _rows(columns):
            stream.write(separator + json.dumps(dict(zip(names, row, strict=True)), allow_nan=False))
            separator = ",\n"
        stream.write("[]\n" if separator == "[\n" else "\n]\n")


def _parquet_writer() -> Callable[[Path, Columns], None]:
    with packages_named("--format parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    def write(path: Path, columns: Columns) -> None:
        arrays = {}
        for name, column in columns.items():
            text = isinstance(column, list)
            arrays[name] = pa.array(column, type=pa.string() if text else None, from_pandas=True)  # NaN: null
        pq.write_table(pa.table(arrays), path)

    return write


def _table_writer(format: str) -> Callable[[Path, Columns], None]:
    if format == "parquet":
        return _parquet_writer()
    return _write_csv if format == "csv" else _write_json
