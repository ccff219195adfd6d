"""A recording in Python: columns, tables, metrics, pictures, folder."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.figure
import numpy as np
import pytest

from handfast.agent.common.errors import Error
from handfast.deploy.api.drive import simulate
from handfast.deploy.api.fleet import load
from handfast.deploy.api.recording import Recording, load_recording
from handfast.deploy.report.export import tabulate
from tests.passing_law import PassingLaw


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate(
        "delta", duration=3, faults='[faults]\n[[faults.rule]]\nat = 1.0\nkill = "agent"\nrobot = 4\n'
    )


@pytest.fixture(scope="module")
def folder(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording.save(tmp_path_factory.mktemp("run") / "saved", report=False)


def test_columns_are_on_one_grid_by_robot_and_by_edge(recording: Recording) -> None:
    k = len(recording.times)
    assert k == 151
    assert (recording.times[0], recording.times[-1]) == (0.0, 3.0)
    assert recording.ids == tuple(recording.hands) == tuple(recording.desired) == (1, 2, 3, 4, 5, 6)
    assert recording.hands[1].shape == recording.desired[1].shape == (k, 2)
    assert tuple(recording.distances) == tuple(recording.wanted) == recording.edges
    assert np.allclose(recording.distances[1, 2], recording.distance(2, 1))
    assert recording.wanted[1, 2][0] == pytest.approx(1.0)


def test_what_each_robot_sent_has_its_own_times(recording: Recording) -> None:
    robot = recording.robots[1]
    n = len(robot.poses.t)
    assert n > 151
    assert all(column.shape == (n,) for column in robot.poses)
    assert robot.hand.navigation.shape == robot.hand.position.shape == (len(robot.hand.t), 2)
    assert np.abs(robot.hand.constraint).max() > 0.0
    assert np.abs(robot.wrenches.force).max() > 0.0
    assert robot.states.at(1.5) == "running"
    assert robot.states.at(-9.0) == ""
    assert [(event.robot, event.process, event.what) for event in recording.events] == [(4, "agent", "kill")]
    assert recording.events[0].t == pytest.approx(1.0)


def test_tables_are_those_of_the_export(recording: Recording) -> None:
    expected = tabulate(recording._result)
    assert recording.tables.keys() == expected.keys() >= {"hands", "plants", "distances", "statuses"}
    assert all(
        np.array_equal(recording.tables["hands"][name], expected["hands"][name]) for name in expected["hands"]
    )


def test_frames_are_pandas(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Error, match="there is no table 'nope'; there are hands"):
        recording.tables["nope"]
    assert "nope" not in recording.tables
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    frame: Any = recording.frame("hands")
    assert {"t_s", "robot", "x_m", "constraint_x_mps2"} <= set(frame)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(Error, match=r"^Recording\.frame needs the package pandas: pip install pandas$"):
        recording.frame("hands")
    with pytest.raises(Error, match="there is no table 'nope'; there are hands"):
        recording.frame("nope")


@pytest.mark.parametrize("name", ["trajectories", "distances", "forces", "timing", "links"])
def test_pictures_are_figures_that_show_themselves(recording: Recording, name: str) -> None:
    figure = recording.plot(name)
    assert isinstance(figure, matplotlib.figure.Figure)
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_a_picture_that_is_none_or_without_matplotlib_is_said(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(Error, match="there is no picture 'nope'; there are trajectories, distances"):
        recording.plot("nope")
    monkeypatch.delitem(sys.modules, "handfast.deploy.report.figures")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(
        Error, match=r"^Recording\.plot needs the package .* pip install 'handfast\[operator\]'$"
    ):
        recording.plot()


def test_it_shows_how_it_went(recording: Recording) -> None:
    assert not recording.passed
    assert recording.metrics["verdict"]["reasons"] == list(recording.reasons)
    assert repr(recording).startswith(
        f"<Recording delta: simulate, 6 robots, 3 s, failed: {recording.reasons[0]}"
    )
    assert "<b>failed</b>" in recording._repr_html_()


def test_a_saved_one_is_what_the_command_leaves_and_reads_again(recording: Recording, folder: Path) -> None:
    assert json.loads((folder / "metrics.json").read_text(encoding="utf-8")) == recording.metrics
    again = load_recording(folder)
    assert again.folder == folder
    assert again.metrics == recording.metrics
    assert np.array_equal(again.hands[3], recording.hands[3])
    assert again.fleet.settings == recording.fleet.settings


def test_one_that_was_read_is_saved_as_a_copy(folder: Path, tmp_path: Path) -> None:
    recording = load_recording(folder)
    copy = recording.save(tmp_path / "copy")
    assert (copy / "run.mcap").read_bytes() == (folder / "run.mcap").read_bytes()
    with pytest.raises(Error, match="is not an empty folder: name another one, or remove it"):
        recording.save(copy)


def test_a_recording_is_looked_at_where_its_plugins_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    law = PassingLaw(tmp_path, monkeypatch, "gone_of_recording")
    changes = {"control.gone.gain": 0.5}
    driven = simulate("pair", changes, law=law.reference, duration=1, out=tmp_path / "run")
    toml = driven.fleet.toml()
    law.leave()
    fleet = load_recording(tmp_path / "run").fleet
    assert (fleet["control.law"], fleet.edges) == (law.reference, driven.fleet.edges)
    assert fleet.toml() == toml, "with the plugin's table"
    assert repr(fleet) == repr(driven.fleet)
    assert f"law: {law.reference}, a plugin" in str(fleet)
    for use in (simulate, load, lambda fleet: fleet.with_(seed=3)):
        with pytest.raises(Error, match="there is no module gone_of_recording"):
            use(fleet)


def test_a_folder_that_holds_no_run_is_said(tmp_path: Path) -> None:
    with pytest.raises(Error, match=r"holds no run\.mcap"):
        load_recording(tmp_path)
