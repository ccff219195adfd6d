"""Formation graphs: their connected parts."""

from __future__ import annotations

from handfast.agent.formation.points import components, connected


def test_components_and_connected():
    assert components(5, [(0, 1), (3, 4), (1, 0)]) == ((0, 1), (2,), (3, 4))
    assert not connected(5, [(0, 1), (3, 4)])
    assert connected(4, [(3, 2), (2, 1), (1, 0)])
    assert connected(1, [])
