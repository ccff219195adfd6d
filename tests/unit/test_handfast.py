"""`import handfast`: what is named is there, loads when it is used, and nothing of ours builds on it."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import handfast

ROOT = Path(__file__).parents[2]
PACKAGES = ("agent", "plant", "bridges", "deploy")


def python(code: str, root: Path = ROOT) -> str:
    """What a new interpreter prints that finds the packages below `root`."""
    environment = os.environ | {"PYTHONPATH": str(root)}
    command = [sys.executable, "-P", "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_every_name_is_there_and_has_a_docstring() -> None:
    for name in handfast.__all__:
        assert getattr(handfast, name).__doc__, name
    assert set(handfast.__all__) <= set(dir(handfast))
    with pytest.raises(AttributeError, match="module 'handfast' has no attribute 'simulat'"):
        handfast.simulat  # noqa: B018


def test_type_checkers_know_the_same_names() -> None:
    (block,) = (
        node
        for node in ast.parse((ROOT / "handfast.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.If)
    )
    imported = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == handfast._MODULES
    assert {*imported, "Error"} == set(handfast.__all__)


def test_its_stubs_are_itself() -> None:
    """So that it is typed for whoever installs it: a single module cannot say that it is."""
    assert (ROOT / "handfast-stubs" / "__init__.pyi").samefile(ROOT / "handfast.py")


def test_importing_it_imports_next_to_nothing() -> None:
    loaded = python(
        "import sys; before = set(sys.modules); import handfast; print(*set(sys.modules) - before)"
    )
    ours = {name for name in loaded.split() if name.startswith((*PACKAGES, "numpy", "matplotlib"))}
    assert ours == {"agent", "handfast.agent.common", "handfast.agent.common.errors"}


def test_on_a_robot_there_is_what_laws_and_plants_need(tmp_path: Path) -> None:
    for package in ("agent", "plant", "bridges"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "handfast.py", tmp_path)
    names = [name for name, module in handfast._MODULES.items() if not module.startswith("deploy")]
    code = f"import handfast, sys\nfor name in {names}: getattr(handfast, name)\n"
    code += "print([name for name in sys.modules if name.startswith('deploy')])"
    assert python(code, tmp_path) == "[]"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_file_in_the_way_of_a_package_is_named_and_not_run(package: str, tmp_path: Path) -> None:
    file = tmp_path / f"{package}.py"
    file.write_text("print('it ran')")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\ntry: import handfast"
    said = f"{file} takes the place of handfast's package {package}: rename it"
    assert python(f"{code}\nexcept ImportError as error: print(error)") == said


def test_none_of_ours_builds_on_it() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not {"handfast"} & {name.partition(".")[0] for name in named}, path
