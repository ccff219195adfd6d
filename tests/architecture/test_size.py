"""The size budget: code lines, modules and complexity of the production code, and code lines of the tests.

A change that needs more room deletes something first. Lower the budget when the code shrinks.
"""

from __future__ import annotations

import ast
import tokenize
from collections.abc import Iterator
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = ("agent", "plant", "bridges", "deploy")

CODE_LINES_MAX: Final = 52_150
MODULES_MAX: Final = 399
COMPLEX_FUNCTIONS_MAX: Final = 54
COMPLEXITY: Final = 15
"""Complexity above which a function counts as complex."""
COMPLEXITY_MAX: Final = 30
TEST_CODE_LINES_MAX: Final = 64_300

_BRANCHES: Final = (
    ast.If,
    ast.For,
    ast.While,
    ast.ExceptHandler,
    ast.IfExp,
    ast.comprehension,
    ast.Assert,
    ast.BoolOp,
)
_LAYOUT: Final = frozenset(
    {
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
        tokenize.COMMENT,
    }
)


def code_lines(source: str) -> int:
    """Number of lines that hold a token other than a comment or a docstring."""
    code: set[int] = set()
    texts: set[int] = set()
    previous = tokenize.ENCODING
    for token in tokenize.generate_tokens(StringIO(source).readline):
        lines = range(token.start[0], token.end[0] + 1)
        if token.type == tokenize.STRING and previous in _LAYOUT:
            texts.update(lines)
        elif token.type not in _LAYOUT:
            code.update(lines)
        previous = token.type
    return len(code - texts)


def complexities(source: str) -> Iterator[tuple[int, str]]:
    """Cyclomatic complexity and name of every function; nested functions count for the outer one too."""
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            nodes = list(ast.walk(function))
            branches = sum(isinstance(node, _BRANCHES) for node in nodes)
            # A chain of n operands is n - 1 branches.
            operands = sum(len(node.values) - 2 for node in nodes if isinstance(node, ast.BoolOp))
            yield 1 + branches + operands, f"{function.name}:{function.lineno}"


@cache
def production() -> dict[Path, str]:
    files = [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]
    return {file: file.read_text(encoding="utf-8") for file in (*files, *(ROOT / "handfast").glob("*.py"))}


def test_production_code_stays_within_its_budget() -> None:
    assert sum(map(code_lines, production().values())) <= CODE_LINES_MAX


def test_modules_stay_within_their_budget() -> None:
    assert len(production()) <= MODULES_MAX


def test_complex_functions_stay_within_their_budget() -> None:
    found = [
        (count, f"{file.relative_to(ROOT)} {name}")
        for file, source in production().items()
        for count, name in complexities(source)
        if count > COMPLEXITY
    ]
    assert len(found) <= COMPLEX_FUNCTIONS_MAX, sorted(found, reverse=True)
    assert not [where for count, where in found if count > COMPLEXITY_MAX]


def test_test_code_stays_within_its_budget() -> None:
    files = (ROOT / "tests").rglob("*.py")
    assert sum(code_lines(file.read_text(encoding="utf-8")) for file in files) <= TEST_CODE_LINES_MAX


def test_lines_and_branches_are_counted_as_they_should_be() -> None:
    source = '''"""A docstring."""

# a comment
def f(a, b):
    """Another,
    of two lines."""
    text = """a string
    of two lines"""
    if a and b and text:  # 1 + 2
        return [x for x in a if x]  # a comprehension
    return None
'''
    assert code_lines(source) == 6
    assert list(complexities(source)) == [(5, "f:4")]
