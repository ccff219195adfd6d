"""Has Python seldom look for garbage during a drive, in which hardly any is made that it would find."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

OBJECTS: Final = 10_000
"""So many more objects there are before the youngest are looked through; by itself Python does it at 700."""


_may_be_left = False
"""Whether this process has driven before: what a drive was made of is garbage when it is let go."""


@contextmanager
def seldom_looked_for() -> Iterator[None]:
    """A context in which what there is already is not looked through, and the rest seldom. What drives before
    it were made of, and nobody has any more, is gone when it begins."""
    global _may_be_left
    before = gc.get_threshold()
    freezes = gc.get_freeze_count() == 0  # what others froze stays so
    if freezes:
        if _may_be_left:
            # Else nobody would ever look for it: frozen in a drive, and among what is old between two.
            # Processes that drive thousands of runs, as a sweep's, grew by some MB with each.
            gc.collect()
        gc.freeze()
    if 0 < before[0] < OBJECTS:  # 0: never
        gc.set_threshold(OBJECTS, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if freezes:
            gc.unfreeze()
        _may_be_left = True
