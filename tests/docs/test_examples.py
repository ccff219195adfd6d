"""The package of examples is as short as its documents say."""

from __future__ import annotations

from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "docs/examples/handfast_examples"


@pytest.mark.parametrize(
    ("name", "below"), [("drag_plant.py", 60), ("spring_law.py", 40), ("consensus_law.py", 60)]
)
def test_an_example_is_short(name: str, below: int) -> None:
    assert len((EXAMPLES / name).read_text().splitlines()) < below
