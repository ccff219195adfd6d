"""Ends calls of others' code that never return, in virtual time: there a whole fleet waits for one.

A law or a plant that hangs in a process of its own is noticed by the other processes. Here a timer raises
`NoAnswerError` inside the call, and who made the call says what that is: its robot is in fault.
"""

from __future__ import annotations

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
