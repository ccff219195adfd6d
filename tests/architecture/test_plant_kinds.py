"""Kinds of plant are told apart in one place: no other module names one."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from handfast.agent.fleet.plants import KINDS

ROOT: Final = Path(__file__).parents[2]
REGISTRY: Final = ROOT / "agent" / "fleet" / "plants.py"


def named(source: str) -> Iterator[tuple[int, str]]:
    """Lines of the strings that are the name of a kind, or say plant = "NAME"; docstrings are for people."""
    tree = ast.parse(source)
    docs = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            for kind in KINDS:
                if node.value == kind or re.search(rf'plant *=+ *"{kind}"', node.value):
                    yield node.lineno, node.value


@pytest.mark.slow
def test_only_the_registry_names_a_kind_of_plant() -> None:
    files = [file for top in ("agent", "plant", "bridges", "deploy") for file in (ROOT / top).rglob("*.py")]
    found = {
        f"{file.relative_to(ROOT)}:{line}"
        for file in [*files, ROOT / "handfast" / "__init__.py"]
        if file != REGISTRY
        for line, _ in named(file.read_text(encoding="utf-8"))
    }
    assert found == set()


def test_it_would_be_seen() -> None:
    source = """def f(robot):\n    'plant = "mavlink" is one'\n    return robot.plant == "unicycle"\n"""
    assert [line for line, _ in named(source)] == [3]
    assert list(named("TEXT = 'with plant = \"mavlink\" only'"))
    assert list(named(REGISTRY.read_text(encoding="utf-8")))
