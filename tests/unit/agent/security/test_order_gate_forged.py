"""Floods of orders that are none: what they cost, and that they keep out nobody else's."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Stop
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import NEW_MAX, NEW_PERIOD_NS, Opener, Order, OrderGate, Sealer
from tests.trusted import FLEET, NOW_S, ROBOTS, authority, credentials

NOW_NS = int(NOW_S * 1e9)
TOLD = key_expressions.relayed(FLEET, 2)


class Counting(Opener):
    """An opener that says how often it was asked."""

    asked = verified = 0

    def open(self, sealed: bytes, now_s: float) -> Order:
        self.asked += 1
        self.verified += not self.has_verified(sealed)
        return super().open(sealed, now_s)


class Scene:
    """A robot's gate, and what it is told: a genuine order, and one that nobody has signed."""

    def __init__(self, folder: Path) -> None:
        with authority(folder / "authority") as by:
            ann = credentials(by, folder / "ann", of_operator(FLEET, "ann"))
        self.order = encode(Stop(2, NOW_NS, "why"))
        self.genuine = Sealer(ann).seal(self.order, NOW_NS)
        sealer = Sealer(ann)
        self.old = [sealer.seal(encode(Stop(1, NOW_NS, f"{number}")), NOW_NS) for number in range(100)]
        self.forged = self.genuine.replace(b"why", b"yhw")
        self.refused: Counter[str] = Counter()
        self.opener = Counting(FLEET, ["ann"], ann.authority)
        self.gate = OrderGate(FLEET, ROBOTS, self.opener, None, self._refuse)

    def _refuse(self, what: str) -> None:
        self.refused[what] += 1

    def flood(self, key: str, now_ns: int) -> None:
        for _ in range(1000):
            assert self.gate.let_in(key, self.forged, now_ns) is None


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_of_a_flood_a_few_are_looked_at_and_all_are_counted(scene: Scene) -> None:
    scene.flood(TOLD, NOW_NS)
    assert scene.opener.asked == NEW_MAX
    assert scene.refused == {
        f"an order on {TOLD}: bad signature": NEW_MAX,
        f"an order on {TOLD}: after too many that were new": 1000 - NEW_MAX,
    }
    scene.flood(TOLD, NOW_NS + NEW_PERIOD_NS)
    assert scene.opener.asked == 2 * NEW_MAX


def test_of_a_flood_of_genuine_ones_a_few_are_looked_at(scene: Scene) -> None:
    """Old orders, overheard: more than are remembered as verified."""
    let_in = [scene.gate.let_in(TOLD, old, NOW_NS) for old in scene.old * 2]
    assert len([each for each in let_in if each is not None]) == 2 * NEW_MAX
    assert scene.opener.verified == NEW_MAX


def test_what_is_known_is_let_in_as_often_as_it_is_told(scene: Scene) -> None:
    for _ in range(100):
        assert scene.gate.let_in(TOLD, scene.genuine, NOW_NS) == scene.order


def test_others_are_let_in(scene: Scene) -> None:
    scene.flood(TOLD, NOW_NS)
    for key in (key_expressions.relayed(FLEET, 1), key_expressions.stop(FLEET)):
        assert scene.gate.let_in(key, scene.genuine, NOW_NS) == scene.order


def test_the_robot_itself_is_let_in_again_soon(scene: Scene) -> None:
    scene.flood(TOLD, NOW_NS)
    late_ns = NOW_NS + NEW_PERIOD_NS
    assert scene.gate.let_in(TOLD, scene.genuine, late_ns - 1) is None
    assert scene.gate.let_in(TOLD, scene.genuine, late_ns) == scene.order
    scene.flood(TOLD, late_ns)
    # A clock that was set back keeps nobody out.
    assert scene.gate.let_in(TOLD, scene.genuine, NOW_NS) == scene.order


def test_what_comes_from_operators_is_always_looked_at(scene: Scene) -> None:
    scene.flood(key_expressions.stop(FLEET), NOW_NS)
    assert scene.gate.let_in(key_expressions.stop(FLEET), scene.genuine, NOW_NS) == scene.order
