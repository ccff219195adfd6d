"""Commands that need no fleet that runs: what they take, and what they need to be installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from deploy.cli import main

ROOT = Path(__file__).parents[2]
OPERATORS = ("matplotlib", "mcap", "pyarrow", "rich", "tomli_w")
WITHOUT = f"""
import sys
sys.modules |= dict.fromkeys({OPERATORS!r})
from deploy.cli import main
sys.exit(main(sys.argv[1:]))
"""


def without_the_operators_packages(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60
    )


def test_a_rover_can_be_simulated_without_the_operators_packages() -> None:
    ran = without_the_operators_packages("rover-simulator", "--listen", "nowhere")
    assert ran.returncode == 2
    assert "nowhere" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_what_is_missing_for_a_command_is_named_with_what_brings_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith(("bridges", "pymap3d", "deploy.placing"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pymap3d", None)
    assert main(["rover-simulator", "--help"]) == 2
    assert "pip install 'handfast[rover]'" in capsys.readouterr().err


def test_the_simulators_options_are_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["rover-simulator", "--help"])
    assert ended.value.code == 0
    assert "--hand-over" in capsys.readouterr().out


def test_a_fleet_of_simulated_robots_has_nothing_to_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["preflight", "pair"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines() == [
        "robot 1  simulated: nothing to check",
        "robot 2  simulated: nothing to check",
        "CLEAR",
    ]


def test_there_is_nobody_to_resume(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["resume", "no-such-fleet-runs"]) == 2
    assert 'no fleet of the name "no-such-fleet-runs" runs here' in capsys.readouterr().err
