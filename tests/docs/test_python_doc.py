"""docs/python.md and the notebook: what they show runs, in order, and is as short as was promised."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
PROCESSES = "handfast.run("
"""What is in a block that starts processes: tests/process/test_api.py runs it."""
NOTEBOOK = json.loads((DOCS / "notebooks" / "first.ipynb").read_text(encoding="utf-8"))
CELLS = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


def statements(block: str) -> int:
    return len([line for line in block.splitlines() if line.strip()])


def run_all(blocks: list[str], name: str) -> dict[str, Any]:
    """Runs pieces of code one after the other, as a notebook does: the last value of each shows itself."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, block in enumerate(blocks):
        tree = ast.parse(block, f"{name}, piece {number + 1}")
        last = tree.body[-1]
        exec(compile(tree, f"{name}, piece {number + 1}", "exec"), names)
        if isinstance(last, ast.Expr):
            shown = eval(compile(ast.Expression(last.value), name, "eval"), names)
            for method in ("_repr_html_", "_repr_png_"):
                getattr(shown, method, lambda: None)()
    return names


def test_three_lines_load_run_and_plot_and_eight_sweep_two_gains_and_plot() -> None:
    assert statements(BLOCKS[0]) == 3
    (sweep,) = (block for block in BLOCKS if "savefig" in block and "handfast.sweep(" in block)
    assert statements(sweep) == 8


@pytest.mark.slow
def test_the_page_runs_word_for_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_all([block for block in BLOCKS if PROCESSES not in block], "docs/python.md")
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"delta.png", "distances.png", "gains.png"}
    assert (tmp_path / "runs" / "late" / "run.mcap").exists()
    assert "control.kq: unknown field" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mpl.use("Agg")
    names = run_all(CELLS, "first.ipynb")
    assert names["recording"].passed
    assert names["mine"].metrics["law"] == "SpringLaw"
    assert not list(tmp_path.iterdir())


def test_the_notebook_is_stored_without_outputs() -> None:
    code = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
    assert max(len(line) for cell in CELLS for line in cell.splitlines()) <= 110
