"""Pure modules decide by their arguments alone: no clock, randomness, operating system or bus."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FORBIDDEN = frozenset({"time", "random", "os", "threading", "asyncio", "socket", "zenoh", "pymavlink"})


def pure_modules() -> list[str]:
    """The one list of them, in import-linter's contract."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (
        c for c in project["tool"]["importlinter"]["contracts"] if c["name"].startswith("pure modules")
    )
    return list(contract["source_modules"])


def imported(source: str) -> set[str]:
    """Top-level names of everything that a module imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.partition(".")[0])
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            names |= {str(a.value).partition(".")[0] for a in node.args if isinstance(a, ast.Constant)}
    return names


@pytest.mark.parametrize("module", pure_modules())
def test_pure_module_imports_no_world(module: str) -> None:
    source = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    assert source.is_file(), f"{module} is listed as pure in pyproject.toml, and there is no such file"
    assert imported(source.read_text(encoding="utf-8")) & FORBIDDEN == set()


@pytest.mark.parametrize(
    "source",
    [
        "import time",
        "import numpy, os.path as p",
        "from random import Random",
        "def f():\n    import socket",
        "from asyncio.events import get_event_loop",
        "if False:\n    from zenoh import Session",
        "import importlib\nm = importlib.import_module('pymavlink.mavutil')",
        "__import__('threading')",
    ],
)
def test_imports_are_seen_wherever_they_are(source: str) -> None:
    assert imported(source) & FORBIDDEN


def test_what_is_no_import_is_not_seen() -> None:
    assert imported("from __future__ import annotations\nfrom math import pi\ntime = os = pi") == {
        "__future__",
        "math",
    }
