"""Drives with processes from Python: a recording at the end, and after Ctrl-C no process."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import handfast

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
RUNS = [block for block in BLOCKS if "handfast.run(" in block]
SCRIPT = """
import handfast
print("here", flush=True)
try:
    {}
except KeyboardInterrupt:
    print("ended")
"""


@pytest.mark.alone
def test_the_page_runs_a_fleet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"handfast": handfast}
    exec("\n".join(RUNS), names)
    assert not capsys.readouterr().err
    measured = names["measured"]
    assert isinstance(measured, handfast.Recording)
    assert (measured.mode, measured.folder) == ("run", Path("runs/pair"))
    assert (tmp_path / "runs" / "pair" / "report.html").exists()
    assert measured.metrics["verdict"]["passed"], measured.metrics["verdict"]
    virtual = handfast.simulate("pair", duration=5)
    assert np.abs(measured.hands[1][:200] - virtual.hands[1][:200]).max() < 0.05
    assert handfast.load_recording("runs/pair").metrics == measured.metrics


@pytest.mark.parametrize(
    ("code", "begun"),
    [
        ("handfast.run('pair', out='run', report=False)", "run/run.mcap"),
        ("handfast.sweep('lattice45', seeds=4, workers=2)", ""),
    ],
    ids=["run", "sweep"],
)
def test_after_ctrl_c_no_process_is_left(tmp_path: Path, code: str, begun: str) -> None:
    """That none is: the fixture for all tests sees to it."""
    command = [sys.executable, "-c", SCRIPT.format(code)]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "here\n"
    deadline = time.monotonic() + 20.0
    while begun and not (tmp_path / begun).exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30.0)
    assert (out, process.returncode) == ("ended\n", 0), err
    if begun:
        assert (tmp_path / "run" / "metrics.json").exists()


MODULE = """
from handfast import Law

class Drift(Law):
    def acceleration(self, now):
        return now.navigation
"""
BESIDE = """
import handfast
from drift import Drift

DRIVING = "running", "degraded"  # by a machine that is slow for a moment
recording = handfast.run("pair", law=Drift, duration=2, report=False)
print(recording.metrics["law"], recording.robots[1].states.at(1.5) in DRIVING, len(recording.reasons))
"""


def test_a_law_may_stand_beside_the_script(tmp_path: Path) -> None:
    (tmp_path / "drift.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "script.py").write_text(BESIDE, encoding="utf-8")
    command = [sys.executable, str(tmp_path / "script.py")]
    done = subprocess.run(command, cwd=tmp_path.parent, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("drift:Drift True 1\n", "")
