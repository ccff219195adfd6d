"""The strip of faults above a figure: what its bars say."""

from __future__ import annotations

import pytest

from handfast.deploy.faults.lanes import Lane
from handfast.deploy.report.drawing.fault_strip import _write
from handfast.deploy.report.drawing.plotting import new_figure


@pytest.mark.parametrize(("length", "is_whole"), [(98, True), (140, False)])
def test_what_fits_into_the_strip_is_written_whole(length: int, is_whole: bool) -> None:
    strip = new_figure(7.6, 0.5).add_subplot()
    text = "x" * length
    _write(strip, Lane(text, [(0.0, 8.0)]), 0, 8.0)
    (written,) = strip.texts
    assert (written.get_text() == text) == is_whole
    assert is_whole or written.get_text().endswith("…")
