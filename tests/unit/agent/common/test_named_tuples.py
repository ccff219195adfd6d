"""What is made without the call of its class is the same as with it."""

from __future__ import annotations

from handfast.agent.common.named_tuples import new
from handfast.agent.control.hand import Hand


def test_it_is_what_its_class_makes() -> None:
    made = new(Hand, (1.0, 2.0, 3.0, 4.0))
    assert type(made) is Hand
    assert made == Hand(x=1.0, y=2.0, vx=3.0, vy=4.0)
    assert made.vy == 4.0
