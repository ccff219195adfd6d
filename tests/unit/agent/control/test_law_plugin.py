"""The base of laws of others."""

from __future__ import annotations

import pytest

from handfast.agent.control.law_plugin import Law
from tests.unit.agent.agent_bench import fleet


def test_a_law_keeps_what_it_was_made_with_and_says_nothing_by_itself():
    made, file = Law(3, fleet(), "settings"), fleet()
    assert (made.robot, made.fleet, made.settings, made.numbers) == (3, file, "settings", ())
    made.restart()
    assert Law.modes(file, None) is None
    with pytest.raises(NotImplementedError):
        made.acceleration(None)  # type: ignore[arg-type]
