"""Pure modules decide by their arguments alone: no clock, randomness, operating system or bus."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FORBIDDEN = frozenset(
    {
        "asyncio",
        "concurrent",
        "ctypes",
        "fcntl",
        "glob",
        "io",
        "logging",
        "mmap",
        "multiprocessing",
        "os",
        "pathlib",
        "pymavlink",
        "queue",
        "random",
        "sched",
        "secrets",
        "select",
        "selectors",
        "serial",
        "shutil",
        "signal",
        "socket",
        "socketserver",
        "ssl",
        "subprocess",
        "sys",
        "tempfile",
        "threading",
        "time",
        "urllib",
        "zenoh",
    }
)
ALLOWED = {
    "handfast.agent.fleet.loading": {"pathlib"},  # reads the fleet file that it is given
}
"""What a module may import all the same, and why."""


def pure() -> list[str]:
    """Packages and modules that are pure, as import-linter's contract lists them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = (
        c for c in project["tool"]["importlinter"]["contracts"] if c["name"].startswith("pure packages")
    )
    return list(contract["source_modules"])


def modules_of(name: str) -> list[str]:
    """The module of this name, or every module below the package of this name."""
    path = ROOT.joinpath(*name.split("."))
    if path.is_dir():
        files = path.rglob("*.py")
        found = [file.relative_to(ROOT).with_suffix("") for file in files]
        return sorted(".".join(file.parts).removesuffix(".__init__") for file in found)
    assert path.with_suffix(".py").is_file(), f"{name} is listed as pure, and there is no such file"
    return [name]


def source_of(module: str) -> str:
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return file.read_text(encoding="utf-8")


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


@pytest.mark.parametrize("module", sorted({module for name in pure() for module in modules_of(name)}))
def test_a_pure_module_imports_no_world(module: str) -> None:
    assert imported(source_of(module)) & FORBIDDEN == ALLOWED.get(module, set())


def test_whole_packages_are_pure() -> None:
    assert len(modules_of("handfast.agent.control")) > 10
    assert "handfast.agent.control" in modules_of("handfast.agent.control")


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
