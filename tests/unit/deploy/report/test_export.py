"""Exported tables: what they hold, in every format."""

from __future__ import annotations

import csv
import errno
import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from handfast.agent.common.errors import PASSED, MissingPackageError
from handfast.agent.messages.codec import encode
from handfast.deploy.cli import main
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import export as export_module
from handfast.deploy.report.export import export, tabulate
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.simulated_run import driven, leave_run, trio
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages, standing, triangle

FLEET = make_fleet(*triangle(2), duration_s=0.4)
TABLES = ("hands", "plants", "wrenches", "multipliers", "distances", "statuses")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Folder of a run whose robot 3 sent nothing but its hand states."""
    with Recorder(tmp_path / "run.mcap", FLEET) as recorder:
        for received_ns, key, message in messages(FLEET, [standing(0, 0), standing(0.9, 0), standing(2, 0)]):
            if "robot/3/" not in key or key.endswith("hand"):
                recorder.record(received_ns, key, encode(message))
    return tmp_path


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_csv(run: Path) -> None:
    paths = export(run, "csv")
    assert paths == [run / "export" / f"{name}.csv" for name in TABLES]
    distances = read_csv(run / "export" / "distances.csv")
    assert list(distances[0]) == ["t_s", "edge_i", "edge_j", "distance_m", "wanted_m"]
    assert len(distances) == 21 * 3
    assert [list(row.values())[:3] for row in distances[:4]] == [
        ["0.0", "1", "2"], ["0.0", "1", "3"], ["0.0", "2", "3"], ["0.02", "1", "2"],
    ]  # fmt: skip
    assert float(distances[0]["distance_m"]) == pytest.approx(0.9)
    assert float(distances[0]["wanted_m"]) == pytest.approx(1.0)
    assert distances[1]["distance_m"] == ""  # of robot 3 nothing is known
    plants = read_csv(run / "export" / "plants.csv")
    assert {row["robot"] for row in plants} == {"1", "2"}
    assert (plants[0]["driving"], plants[0]["x_m"], plants[0]["heading_rad"]) == ("true", "0.0", "0.0")
    assert {row["robot"] for row in read_csv(run / "export" / "hands.csv")} == {"1", "2", "3"}


def test_json_holds_the_same(run: Path) -> None:
    export(run, "csv", run / "a")
    paths = export(run, "json", run / "b")
    for path in paths:
        records = json.loads(path.read_text())
        rows = read_csv(run / "a" / f"{path.stem}.csv")
        assert len(records) == len(rows) > 0
        for record, row in zip(records, rows, strict=True):
            assert list(record) == list(row)
            for name, value in record.items():
                text = "" if value is None else str(value).lower() if value in (True, False) else str(value)
                assert text == row[name] or float(text) == float(row[name])


def test_parquet_holds_the_same(run: Path) -> None:
    tables = tabulate(RunResult(read_run(run)))
    for path in export(run, "parquet"):
        stored = pq.read_table(path)
        expected = tables[path.stem]
        assert stored.column_names == list(expected)
        for name, column in expected.items():
            values = column if isinstance(column, list) else column.tolist()
            assert stored[name].to_pylist() == [None if value != value else value for value in values]
    statuses = tables["statuses"]
    assert set(statuses["transition"]) == {"epoch"}
    assert set(np.asarray(statuses["mission_version"]).tolist()) == {1}
    kinds = {field.name: str(field.type) for field in pq.read_schema(run / "export" / "statuses.parquet")}
    assert (kinds["t_s"], kinds["robot"], kinds["state"], kinds["sent"]) == (
        "double",
        "int64",
        "string",
        "int64",
    )


def test_the_truth_has_a_table_of_its_own_where_there_is_one(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", FLEET) as recorder:
        for received_ns, key, message in messages(FLEET, in_formation(FLEET), truth=True):
            recorder.record(received_ns, key, encode(message))
    tables = tabulate(RunResult(read_run(tmp_path)))
    assert set(tables) == {*TABLES, "truths"}
    measured, true = (np.asarray(tables[name]["x_m"]) for name in ("plants", "truths"))
    assert measured == pytest.approx(true + 0.5)


def test_what_of_a_damaged_recording_is_missing_is_said(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run)]) == PASSED
    assert capsys.readouterr().err == ""
    recorded = run / "run.mcap"
    recorded.write_bytes(recorded.read_bytes()[:-200])
    assert main(["export", str(run), "--out", str(run / "again")]) == PASSED
    err = capsys.readouterr().err
    assert err.startswith("warning: ")
    assert "cut short or damaged" in err


def test_what_cannot_be_exported_is_one_clear_line(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        RecordingError, match=r"^unknown format 'xlsx'; there are csv, parquet, json, rosbag2, mp4, gif$"
    ):
        export(run, "xlsx")
    (run / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"empty holds no run\.mcap"):
        export(run / "empty", "csv")
    (run / "file").touch()
    with pytest.raises(RecordingError, match=rf"^cannot write the export to {run / 'file'}: File exists$"):
        export(run, "csv", run / "file")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingPackageError, match=r"pyarrow: pip install 'handfast\[tables\]'$"):
        export(run, "parquet")


@pytest.mark.parametrize("format", ["csv", "json", "parquet"])
@pytest.mark.parametrize("ending", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_what_is_not_written_to_its_end_changes_nothing(
    run: Path, monkeypatch: pytest.MonkeyPatch, format: str, ending: BaseException
) -> None:
    """Half a table, or tables of two runs side by side, would be taken for those of one."""
    written = export(run, format)
    before = {path: path.read_bytes() for path in written}
    write = export_module._table_writer(format)

    def last_fails(path: Path, columns: export_module.Columns) -> None:
        path.write_text("half of")
        if "wanted_m" in columns:
            raise ending
        write(path, columns)

    monkeypatch.setattr(export_module, "_table_writer", lambda _format: last_fails)
    with pytest.raises(
        KeyboardInterrupt if isinstance(ending, KeyboardInterrupt) else RecordingError
    ) as caught:
        export(run, format)
    if isinstance(ending, OSError):
        named = run / "export"
        assert str(caught.value) == f"cannot write the export to {named}: No space left on device"
    assert {path: path.read_bytes() for path in (run / "export").iterdir()} == before


def test_what_was_done_to_messages(tmp_path: Path) -> None:
    fleet = trio('[[faults.rule]]\nlink = "1->2"\nloss = "50%"\ndelay = "30ms"\nat = 0.5\n', duration=1.0)
    folder = leave_run(tmp_path / "run", fleet, driven(fleet))
    export(folder, "csv")
    rows = read_csv(folder / "export" / "links.csv")
    assert list(rows[0]) == [
        "t_s", "source", "destination", "topic", "sequence", "lost", "duplicated", "corrupted", "reordered",
        "range", "overflow", "delay_s",
    ]  # fmt: skip
    assert {(row["source"], row["destination"], row["topic"]) for row in rows} == {("1", "2", "hand")}
    assert {(row["lost"], row["delay_s"]) for row in rows} == {("true", ""), ("false", "0.03")}
    assert 15 < len(rows) < 50
    assert float(rows[0]["t_s"]) == pytest.approx(0.51)
    export(folder, "parquet", tmp_path / "p")
    assert pq.read_table(tmp_path / "p" / "links.parquet")["delay_s"].null_count > 0
