"""Sweeps from Python: a grid of values, columns and pictures of what came of it."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib.figure
import numpy as np
import pytest

from handfast.agent.common.errors import Error
from handfast.agent.control.own_law import Law
from handfast.deploy.api.drive import simulate
from handfast.deploy.api.sweep import Sweep, sweep


@pytest.fixture(scope="module")
def found() -> Sweep:
    return sweep(
        "pair",
        {"control.kp": [1, 0.5], "faults.delay": ["20ms", 0]},
        duration=4,
        seeds=np.int64(2),
        workers=np.int64(2),
    )


def test_it_has_a_row_for_each_run_and_a_grid_for_each_metric(found: Sweep) -> None:
    assert (found.fields, found.shape, found.seeds) == (("control.kp", "faults.delay"), (2, 2), 2)
    assert found.values == {"control.kp": (0.5, 1), "faults.delay": (0, "20ms")}
    assert {len(column) for column in found.columns.values()} == {8}
    assert found.columns["control.kp"].tolist() == [0.5] * 4 + [1.0] * 4
    assert found.metric("rms_distance_error_m").shape == (2, 2, 2)
    assert np.isfinite(found.metric("min_distance_m.any")).all()
    assert (found.metric("passed") == 1.0).all() == found.passed
    assert repr(found).startswith("<Sweep over control.kp (2), faults.delay (2): 8 runs, ")


def test_a_run_of_it_can_be_driven_alone(found: Sweep) -> None:
    alone = simulate(found.fleet(5))
    row = found.columns["rms_distance_error_m"][5]
    assert alone.metrics["rms_distance_error_m"] == row
    assert found.fleet(found.columns["rms_distance_error_m"].argmax()).name == "pair"  # numpy's whole number
    with pytest.raises(Error, match="there is no run 8: they are 0 to 7"):
        found.fleet(8)
    for given in ("a", 1.0, None, True):
        with pytest.raises(Error, match=f"^a run must be a whole number, got {given!r}$"):
            found.fleet(given)  # type: ignore[arg-type]


def test_what_every_run_draws_is_a_column() -> None:
    drawn = sweep("pair", {"faults.delay": "0..1.4s"}, duration=0.5, seeds=3, workers=2, check=False)
    assert (drawn.fields, drawn.shape) == ((), ())
    delays = drawn.columns["faults.delay"]
    assert len(set(delays.tolist())) == 3
    assert ((delays >= 0.0) & (delays <= 1.4)).all()
    for arguments, says in (
        ({"workers": 2, "cluster": "tcp://there:8786"}, r"leave out --jobs \(workers in Python\)"),
        ({"cluster": "there"}, "must be tcp://HOST:PORT"),
        ({"cluster_wait": 600.0}, r"\(cluster_wait in Python\) needs a cluster"),
        ({"cluster": "tcp://there:1", "cluster_wait": -1}, "cluster_wait must be a number above 0, got -1"),
    ):
        with pytest.raises(Error, match=says):
            sweep("pair", **arguments)


def test_pictures_are_figures(found: Sweep) -> None:
    assert isinstance(found.plot(), matplotlib.figure.Figure)
    assert isinstance(found.plot("share_safe"), matplotlib.figure.Figure)
    with pytest.raises(Error, match="there is no picture 'nope'; there are settling_time, "):
        found.plot("nope")
    with pytest.raises(Error, match="there is no metric 'nope'; there are "):
        found.metric("nope")
    with pytest.raises(Error, match=r"there is no column 'nope'; there are control\.kp, "):
        found.columns["nope"]
    with pytest.raises(Error, match=r"there is no field 'nope'; there are control\.kp, faults\.delay"):
        found.values["nope"]


def test_frames_are_pandas(found: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    frame: Any = found.frame()
    assert set(frame) == set(found.columns)


def test_what_is_varied_wins_over_a_change() -> None:
    one = sweep("pair", {"control.kp": [1.0]}, {"control.kp": 2.0}, duration=1, workers=1)
    assert one.fleet(0)["control.kp"] == 1.0
    assert isinstance(one.plot(), matplotlib.figure.Figure)


@pytest.mark.parametrize("over", [None, {}])
def test_nothing_varied_is_one_cell(over: dict[str, Any] | None) -> None:
    one = sweep("pair", over, duration=1, seeds=2, workers=1)
    assert (one.fields, one.shape, one.metric("passed").shape) == ((), (), (2,))
    assert repr(one).startswith("<Sweep over nothing: 2 runs, ")
    with pytest.raises(Error, match=r"^no field is varied over values: there is nothing to plot$"):
        one.plot()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"over": {"control.kp": 1}}, r"^control\.kp: a list of values was expected, got 1$"),
        ({"over": {"control.kp": []}}, r"^control\.kp: no values are given$"),
        ({"over": {"control.kp": [1, 1.0]}}, r"^control\.kp: gives 1 and 1\.0, which are the same$"),
        ({"over": ["control.kp"]}, "^what is varied is given by field"),
        ({"over": {"control.kq": [1]}}, r"  control\.kq: unknown field"),
        ({"over": {"kp": [1]}}, "^kp=1: must be written as table.field"),
        ({"over": {"fleet.seed": [1]}}, r"^fleet\.seed: each run has a seed of its own"),
        ({"seeds": 0}, "^seeds must be a whole number of at least 1, got 0$"),
        ({"workers": "many"}, "^workers must be a whole number of at least 1, got 'many'$"),
        (
            {"over": {"control.c2": [1.0, 2000.0]}},
            r"^not started .* with control\.c2=2000\.0, fleet\.rate_hz: ",
        ),
        ({"random_starts": "big"}, r"^random_starts must be a number above 0, got 'big'$"),
        ({"random_starts": -1}, r"^random_starts must be a number above 0, got -1$"),
        ({"random_starts": 0.01}, "^random starts: no room for 2 robots"),
    ],
)
def test_nonsense_is_said_in_one_error(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(Error, match=says):
        sweep("pair", **arguments)


def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    """Workers do not run the script that started them once more."""
    script = tmp_path / "script.py"
    script.write_text(
        "import handfast\n"
        "print('once')\n"
        "found = handfast.sweep('pair', {'control.kp': [0.5, 1]}, duration=1, workers=2)\n"
        "print(found.metric('safe').ravel())\n",
        encoding="utf-8",
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr, done.returncode) == ("once\n[1. 1.]\n", "", 0)


NOTEBOOK = """
from __future__ import annotations
from dataclasses import dataclass
from typing import Literal
import handfast

@dataclass(frozen=True)
class Push:
    way: Literal["x", "y"] = handfast.setting("x", "Where to.")
    force: float = handfast.setting(0.1, "How strong.", unit="m/s2", ge=-1, le=1)

class PushLaw(handfast.Law):
    section = "push"
    Settings = Push

    def acceleration(self, now):
        return (self.settings.force, 0.0) if self.settings.way == "x" else (0.0, self.settings.force)

found = handfast.sweep("pair", {"control.push.force": [-0.1, 0.1]}, law=PushLaw, duration=1, workers=2)
here = handfast.simulate(found.fleet(1))
print(found.columns["rms_distance_error_m"][1] == here.metrics["rms_distance_error_m"], here.metrics["law"])
"""


def test_a_class_that_cannot_be_sent_to_workers_is_named() -> None:
    class Locked(Law):
        lock = threading.Lock()

    with pytest.raises(Error, match=r"^Locked: cannot be sent to the processes of a sweep"):
        sweep("pair", {"control.c1": [0.4, 0.5]}, law=Locked, duration=1, check=False)


def test_a_law_of_a_script_reaches_the_workers(tmp_path: Path) -> None:
    command = [sys.executable, "-c", NOTEBOOK]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("True PushLaw\n", "")
