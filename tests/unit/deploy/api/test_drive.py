"""Drives in virtual time from Python: the same as the command's, in memory."""

from __future__ import annotations

import hashlib
import json
from math import cos, sin
from pathlib import Path

import numpy as np
import pytest

from handfast.agent.common.errors import Error
from handfast.agent.control.hand import Pose
from handfast.agent.control.own_law import Law, Moment
from handfast.deploy import cli
from handfast.deploy.api.drive import run, simulate
from handfast.deploy.api.fleet import load
from handfast.plant.backend import Command, Plant, Reading, Setup


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_it_is_the_run_that_the_command_drives(tmp_path: Path) -> None:
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    cli.main(
        [
            "simulate",
            "delta",
            "--duration",
            "3",
            "--seed",
            "5",
            "--no-report",
            "--quiet",
            "--out",
            str(theirs),
        ]
    )
    recording = simulate("delta", duration=3, seed=5, out=ours, report=False)
    assert recording.folder == ours
    assert recording.metrics == json.loads((theirs / "metrics.json").read_text(encoding="utf-8"))
    for name in ("run.mcap", "fleet.toml", "metrics.json"):
        assert digest(ours / name) == digest(theirs / name), name


def test_nothing_is_written_unless_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert simulate("pair", duration=1).folder is None
    assert not list(tmp_path.iterdir())


def test_progress_is_told_as_a_share(capsys: pytest.CaptureFixture[str]) -> None:
    shares: list[float] = []
    simulate("pair", duration=2, progress=shares.append)
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    simulate("pair", duration=2, progress=True)
    assert capsys.readouterr().err.endswith("100 %\n")


def test_progress_that_is_no_function_is_refused() -> None:
    with pytest.raises(Error, match=r"^progress must be True, False or a function .*, got 3$"):
        simulate("pair", duration=1, progress=3)  # type: ignore[arg-type]


def test_errors_of_check_are_refused_unless_said_otherwise() -> None:
    with pytest.raises(Error, match="not started"):
        simulate("pair", {"control.c2": 2000.0}, duration=1)
    simulate("pair", {"control.c2": 2000.0}, duration=1, check=False)


def test_a_folder_that_is_not_empty_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(Error, match="is not an empty folder: name another one, or remove it"):
        simulate("pair", duration=1, out=tmp_path)


class Drift(Law):
    """Goes where navigation wants, whatever the neighbours do."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


def local(law: type[Law]) -> type[Law]:
    """The class as a script or a notebook has it, which no other process can import."""
    return type(law.__name__, (law,), {"__module__": "__main__"})


def test_a_law_is_a_class_wherever_it_is_defined() -> None:
    alone, importable = (
        simulate("pair", law=local(Drift), duration=2),
        simulate("pair", law=Drift, duration=2),
    )
    assert alone.metrics["law"] == "Drift"
    assert importable.metrics["law"].endswith(":Drift")
    assert np.array_equal(alone.hands[1], importable.hands[1])
    assert not np.array_equal(alone.hands[1], simulate("pair", duration=2).hands[1])


def test_a_class_of_the_same_name_takes_the_place_of_the_one_before() -> None:
    class Push(Drift):
        def acceleration(self, now: Moment) -> tuple[float, float]:
            return 0.1, 0.0

    first = load("pair", law=local(Drift), duration=1)
    Push.__name__ = "Drift"
    second = load("pair", law=local(Push), duration=1)
    one, other, again = simulate(first), simulate(second), simulate(first)
    assert np.array_equal(one.hands[1], again.hands[1])
    assert not np.array_equal(one.hands[1], other.hands[1])


def test_a_class_of_this_process_cannot_go_to_others() -> None:
    with pytest.raises(Error, match=r"^Drift: robots' processes cannot import a class that is defined here"):
        run("pair", law=local(Drift))
    with pytest.raises(Error, match=r"^Drift: a file cannot name a class that is defined here"):
        load("pair", law=local(Drift)).save("nowhere.toml")


class Rail(Plant):
    """A body that goes where it is pushed, along its first heading alone."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.pose = Pose(*setup.start, speed=0.0, yaw_rate=0.0)
        self.time_ns: int | None = None
        self.force = 0.0

    def step(self, now_ns: int, command: Command | None) -> Reading:
        dt = 0.0 if self.time_ns is None else (now_ns - self.time_ns) / 1e9
        x, y, heading, speed, _ = self.pose
        way = dt * speed
        speed += dt * self.force / self.setup.robot.mass_kg
        self.pose = Pose(x + way * cos(heading), y + way * sin(heading), heading, speed, 0.0)
        self.time_ns = now_ns
        self.force = -20.0 * speed if command is None else command.force
        return Reading(now_ns, self.pose, self.force, 0.0)


def test_a_plant_is_a_class_wherever_it_is_defined() -> None:
    local_rail = type("Rail", (Rail,), {"__module__": "__main__"})
    alone, importable = (simulate("pair", plant=each, duration=2) for each in (local_rail, Rail))
    assert {robot.plant for robot in alone.fleet.settings.robots} == {"Rail"}
    assert np.ptp(alone.robots[1].poses.heading) == 0.0
    assert np.array_equal(alone.hands[1], importable.hands[1])
    with pytest.raises(Error, match=r"^Rail: robots' processes cannot import a class"):
        run(alone.fleet)
