"""`import handfast`: what is named is there, loads when it is used, and nothing of ours builds on it."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import tarfile
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
    for name in set(handfast.__all__) - {"__version__"}:
        assert getattr(handfast, name).__doc__, name
    assert set(handfast.__all__) <= set(dir(handfast))
    with pytest.raises(AttributeError, match="module 'handfast' has no attribute 'simulat'"):
        handfast.simulat  # noqa: B018


def test_type_checkers_know_the_same_names() -> None:
    (block,) = (
        node
        for node in ast.parse((ROOT / "handfast" / "__init__.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.If)
    )
    imported = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module != "typing"
        for alias in node.names
    }
    assert imported == handfast._MODULES
    assert {*imported, "__version__"} == set(handfast.__all__)


def test_importing_it_imports_next_to_nothing() -> None:
    loaded = python(
        "import sys; before = set(sys.modules); import handfast; print(*set(sys.modules) - before)"
    )
    assert set(loaded.split()) - {"__future__"} == {"handfast"}


def test_on_a_robot_there_is_what_laws_and_plants_need(tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("__pycache__", "deploy")
    shutil.copytree(ROOT / "handfast", tmp_path / "handfast", ignore=ignored)
    names = [name for name, module in handfast._MODULES.items() if not module.startswith("handfast.deploy")]
    code = f"import handfast, sys\nfor name in {names}: getattr(handfast, name)\n"
    code += "print([name for name in sys.modules if name.startswith('handfast.deploy')])"
    assert python(code, tmp_path) == "[]"


def test_files_of_a_user_with_the_names_of_our_packages_are_left_alone(tmp_path: Path) -> None:
    for package in PACKAGES:
        (tmp_path / f"{package}.py").write_text("raise SystemExit('it ran')")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import handfast; print(handfast.Fleet.__name__)"
    )
    assert python(code) == "Fleet"


@pytest.mark.slow
def test_none_of_ours_builds_on_it() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                named = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert "handfast" not in named, path


def test_a_source_distribution_holds_every_module(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
    modules = {
        f"handfast/{path.relative_to(ROOT)}" for top in PACKAGES for path in (ROOT / top).rglob("*.py")
    }
    assert modules <= names
