"""What `make compiled` makes: the same program, to the bit, and it is the one that runs.

It is started in the source tree on purpose: packages there must not take the place of what is compiled.
"""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import pytest

from tests.process.harness import children, wait_for

ROOT = Path(__file__).parents[2]
COMPILED = ROOT / ".venv-compiled" / "bin"
PYTHON = ROOT / ".venv" / "bin" / "python"

pytestmark = [pytest.mark.compiled, pytest.mark.timeout(900)]


def said(*words: str | Path) -> str:
    done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout


def test_every_message_of_simulated_drives_is_the_same_to_the_bit() -> None:
    hashes = ROOT / "tests" / "message_hashes.py"
    compiled, python = said(COMPILED / "python", hashes), said(PYTHON, hashes)
    assert compiled.splitlines() == python.splitlines()
    assert len(compiled.splitlines()) > 20


def test_every_module_comes_up() -> None:
    """A class that is left as Python cannot be made of one that is compiled."""
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("agent", "plant", "bridges", "deploy")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.name not in ("__init__.py", "__main__.py")
    ]
    assert len(names) > 200
    said(COMPILED / "python", "-P", "-W", "error", "-c", f"import {', '.join(names)}")


def test_the_command_says_which_form_it_is() -> None:
    assert said(COMPILED / "handfast", "--version").endswith("(compiled)\n")
    assert said(ROOT / ".venv" / "bin" / "handfast", "--version").endswith("(pure Python)\n")


def test_all_robots_of_a_run_are_compiled(tmp_path: Path) -> None:
    words = [COMPILED / "handfast", "run", "pair", "--set", "fleet.duration_s=60", "--out", tmp_path / "run"]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL) as command:

        def compiled() -> bool:
            robots = [pid for pid, what in children(command.pid).items() if "--robot" in what]
            maps = [Path(f"/proc/{pid}/maps") for pid in robots]
            return len(maps) == 4 and all("__mypyc" in each.read_text() for each in maps)

        try:
            wait_for(compiled, "two agents and two plants that are compiled")
        finally:
            command.send_signal(signal.SIGINT)
    assert command.returncode == 130
