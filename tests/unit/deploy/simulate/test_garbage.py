"""What a drive sets for the garbage collector is as it was afterwards."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from handfast.deploy.simulate.garbage import OBJECTS, seldom_looked_for


@pytest.fixture(autouse=True)
def _restored() -> Iterator[None]:
    before = gc.get_threshold()
    gc.unfreeze()  # what tests before this one have frozen
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


def test_it_is_as_it_was_afterwards_whatever_happens() -> None:
    def drive() -> None:
        with seldom_looked_for():
            assert gc.get_threshold() == (OBJECTS, 7, 8)
            assert gc.get_freeze_count() > 0
            raise KeyError

    gc.set_threshold(500, 7, 8)
    with pytest.raises(KeyError):
        drive()
    assert gc.get_threshold() == (500, 7, 8)
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("objects", [0, 10 * OBJECTS])
def test_who_has_it_look_less_often_or_never_keeps_that(objects: int) -> None:
    gc.set_threshold(objects, 7, 8)
    with seldom_looked_for():
        assert gc.get_threshold() == (objects, 7, 8)


def test_what_others_have_frozen_stays_so() -> None:
    gc.freeze()
    with seldom_looked_for():
        pass
    assert gc.get_freeze_count() > 0


class _Node:
    """One of those that a drive is made of: they know each other."""

    def __init__(self) -> None:
        self.other = self


def test_what_a_drive_was_made_of_is_gone_when_the_next_begins() -> None:
    """Whoever drives thousands of runs does not grow with each."""
    gc.disable()
    try:
        with seldom_looked_for():
            node = _Node()
            left = weakref.ref(node)
        del node
        assert left() is not None, "nobody has looked"
        with seldom_looked_for():
            assert left() is None
    finally:
        gc.enable()
