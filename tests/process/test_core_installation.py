"""A wheel with the packages that handfast needs and no extra: fleets are checked, simulated and run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import venv
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOCKED = re.compile(r"^([\w.-]+)==", re.MULTILINE)
NOTHING_KEPT = (
    "handfast: there will be no recording and no report: the package mcap is not installed: "
    "pip install 'handfast[operator]'\n"
)
Handfast = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def handfast(tmp_path_factory: pytest.TempPathFactory) -> Handfast:
    """The command of an environment of its own, which shares the core's packages with ours."""
    folder = tmp_path_factory.mktemp("core")
    wheel = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([sys.executable, "-m", "pip", "--quiet", *wheel, str(ROOT)], check=True, timeout=120)
    venv.create(folder / "venv", with_pip=False)
    (packages,) = (folder / "venv" / "lib").glob("python*/site-packages")
    for name in LOCKED.findall((ROOT / "requirements" / "core.txt").read_text()):
        found = distribution(name)
        for top in {
            path.parts[0] for path in found.files or () if path.parts[0] not in ("..", "__pycache__")
        }:
            (packages / top).symlink_to(Path(str(found.locate_file(top))))
    (built,) = folder.glob("*.whl")
    install = ["install", "--no-deps", "--no-index", "--no-compile", "--target", str(packages), str(built)]
    subprocess.run([sys.executable, "-m", "pip", "--quiet", *install], check=True, timeout=120)

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        words = [str(folder / "venv" / "bin" / "python"), "-m", "handfast", *arguments]
        return subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120)

    return run


def test_a_fleet_is_checked(handfast: Handfast) -> None:
    checked = handfast("check", "delta")
    assert (checked.returncode, checked.stderr) == (0, "")


@pytest.mark.parametrize("command", ["simulate", "run"])
def test_a_fleet_drives_and_is_judged_without_a_report(
    handfast: Handfast, command: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    drove = handfast(command, "delta", "--duration", "15s", "--quiet", "--out", str(out))
    assert drove.stderr.startswith(NOTHING_KEPT)
    assert "Traceback" not in drove.stderr
    assert (drove.returncode, drove.stdout.split()[0]) == (0, "PASSED"), drove.stdout
    assert json.loads((out / "metrics.json").read_text())["verdict"]["passed"]
    assert not (out / "report.html").exists()
