"""What `make compiled` makes: the same program, to the bit, and it is the one that runs.

It is started in the source tree on purpose: packages there must not take the place of what is compiled.
"""

from __future__ import annotations

import signal
import subprocess
import zipfile
from pathlib import Path

import pytest

from tests.process.harness import children, wait_for

ROOT = Path(__file__).parents[2]
COMPILED = ROOT / ".venv-compiled" / "bin"
PYTHON = ROOT / ".venv" / "bin" / "python"

EXTRA = "cluster"
"""A package that needs what only its extra has."""

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
        if path.name not in ("__init__.py", "__main__.py") and path.parent.name != EXTRA
    ]
    assert len(names) > 200
    said(COMPILED / "python", "-P", "-W", "error", "-c", f"import {', '.join(names)}")


def test_what_a_node_listens_to_is_one_object_until_it_is_something_else() -> None:
    """Loops compare it by identity. A tuple of a certain length is made anew in C whenever it is asked for,
    and then each tick of a plant listened anew to all."""
    source = """
from handfast.agent.core import Agent
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.arguments import fleet_path
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet

fleet = resolved(load_fleet(fleet_path("pair")))
for node in (Agent(fleet, 1), PlantNode(fleet, 1, from_fleet(fleet, 1))):
    for name in ("subscriptions", "watched", "lasting"):
        assert getattr(node, name) is getattr(node, name), (node, name)
"""
    said(COMPILED / "python", "-P", "-c", source)


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


def test_what_is_sent_to_a_robots_computer_of_this_kind_is_compiled(tmp_path: Path) -> None:
    """Its wheel beside our packages, as `handfast up` installs them; without the wheel they are Python."""
    made = (
        "from pathlib import Path; "
        "from handfast.deploy.hosts.bundle import PACKAGES, program_archive; "
        "from handfast.deploy.hosts.bundle import compiled_modules, wheel; "
        "name, data = wheel(compiled_modules(PACKAGES)); Path(name).write_bytes(data); "
        "Path('program.zip').write_bytes(program_archive())"
    )
    subprocess.run([COMPILED / "python", "-P", "-c", made], cwd=tmp_path, check=True)
    (built,) = tmp_path.glob("*.whl")
    words = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--target",
        tmp_path / "there",
        built,
    ]
    said(PYTHON, *words)
    form = "import sys; sys.path.insert(0, sys.argv[1]); from handfast.agent.common.compiled import FORM"
    for name, wanted in (("there", "compiled"), ("pure", "pure Python")):
        with zipfile.ZipFile(tmp_path / "program.zip") as archive:
            archive.extractall(tmp_path / name)
        shown = said(PYTHON, "-P", "-c", f"{form}; import handfast.agent.core; print(FORM)", tmp_path / name)
        assert shown == f"{wanted}\n"
