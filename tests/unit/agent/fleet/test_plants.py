"""agent.fleet.plants: kinds of plant, ours and those of others."""

from __future__ import annotations

import pytest

from agent.common.plugins import PluginError
from agent.fleet import plants


def test_ours() -> None:
    assert plants.kind("unicycle") is plants.KINDS["unicycle"]
    assert [entry.key for entry in plants.built_in_sections()] == ["mavlink"]


def test_no_kind() -> None:
    wrong = 'must be one of "unicycle", "mavlink", or a plugin, got "unicyle"; did you mean "unicycle"?'
    with pytest.raises(PluginError) as caught:
        plants.kind("unicyle")
    assert str(caught.value) == wrong
    with pytest.raises(PluginError, match='or a plugin, got "tractor": no plugin has the name "tractor"'):
        plants.kind("tractor")
    with pytest.raises(PluginError, match=r"^a\.b:C: there is no module a"):
        plants.kind("a.b:C")
