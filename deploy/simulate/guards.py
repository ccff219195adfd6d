"""Guards around a drive in virtual time: against plugins that never return, and against useless collections.

A law or a plant that hangs in a process of its own is noticed by the other processes. In virtual time a whole
fleet waits for it. So a timer raises `NoAnswerError` inside the call, and the caller puts its robot in fault.
"""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from handfast.agent.common import plugins
from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis import patience

_LOOK_S: Final = 1.0
"""How often it is looked whether a call goes on for too long."""


@contextmanager
def ended(fleet: Fleet) -> Iterator[Callable[[], None]]:
    """A context in which a call of the code of a fleet's plugins ends after `patience.ANSWER_S` of real time.

    Gives a function to be called whenever the drive has come on. A fleet without plugins costs nothing;
    outside of the main thread, and in code that does not come back to Python, nothing can be ended.
    """
    is_main = threading.current_thread() is threading.main_thread()
    has_plugins = fleet.control.law is not None or any(robot.kind.is_plugin for robot in fleet.robots)
    if not (is_main and has_plugins and hasattr(signal, "setitimer")):
        yield lambda: None
        return
    looks = 0

    def came_on() -> None:
        nonlocal looks
        looks = 0

    def look(_number: int, frame: FrameType | None) -> None:
        nonlocal looks
        looks += 1
        if looks * _LOOK_S > patience.ANSWER_S and _is_in_a_call(frame):
            looks = 0
            raise plugins.NoAnswerError(f"did not return within {patience.ANSWER_S:g} s")

    before = signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, _LOOK_S, _LOOK_S)
    try:
        yield came_on
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _is_in_a_call(frame: FrameType | None) -> bool:
    """Whether code of others runs there, which is called by `plugins.attempt` alone."""
    while frame is not None and frame.f_code is not plugins.attempt.__code__:
        frame = frame.f_back
    return frame is not None


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
