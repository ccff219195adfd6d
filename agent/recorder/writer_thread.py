"""Puts what a recorder heard on the disk, in a thread of its own: who hears never waits for a disk."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from types import TracebackType
from typing import Final, NamedTuple, Self

from handfast.agent.recorder.recorder import RobotRecorder

WAITING_BYTES_MAX: Final = 16_000_000
"""So much may wait for the disk: more than a minute of one robot."""
MESSAGE_BYTES: Final = 250
"""What a message takes in memory beside its key and payload."""


class _Heard(NamedTuple):
    """What was heard at one time (wall clock, ns), after `lost` messages that were given up. `step_s`: by how
    much the clock was set then."""

    now_ns: int
    messages: Sequence[tuple[str, bytes]]
    lost: int
    overflow: bool
    step_s: float

    @property
    def size(self) -> int:
        return sum(len(key) + len(payload) + MESSAGE_BYTES for key, payload in self.messages)


class RecorderThread:
    """Has `recorder` take what was heard. A context manager, whose end waits until all is on the disk.

    Attributes:
        error: what ended the thread before its time; None while it works.
    """

    def __init__(self, recorder: RobotRecorder) -> None:
        self._recorder = recorder
        self._waiting: deque[_Heard] = deque()
        self._bytes = self._lost = 0
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.error: BaseException | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
        self._thread.join()

    def hear(
        self,
        now_ns: int,
        messages: Sequence[tuple[str, bytes]],
        *,
        overflow: bool = False,
        step_s: float = 0.0,
    ) -> None:
        """Takes what was received at `now_ns` (wall clock), and that it is that late; counts what there is no
        room for.

        Args:
            overflow: messages were lost before these, it is not known how many.
            step_s: by how much the wall clock was set after these.
        """
        heard = _Heard(now_ns, messages, 0, overflow, step_s)
        with self._changed:
            size = heard.size
            if self._bytes + size > WAITING_BYTES_MAX:
                self._lost += len(messages)
                heard, size = heard._replace(messages=()), 0
            if self._waiting and not (heard.messages or overflow or step_s):
                return  # what waits will tell the time
            self._waiting.append(heard._replace(lost=self._lost))
            self._lost = 0
            self._bytes += size
            self._changed.notify()

    def end(self) -> None:
        """The thread ends when all that was heard is on the disk; see `working`."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    @property
    def working(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    # ------------------------------------------------------------------ the thread

    def _run(self) -> None:
        try:
            now_ns = 0
            while (heard := self._next()) is not None:
                self._take(heard)
                now_ns = heard.now_ns
            self._recorder.flush(now_ns)
        except BaseException as error:  # whoever hears has to end
            self.error = error

    def _next(self) -> _Heard | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            if not self._waiting:
                return None
            heard = self._waiting.popleft()
            self._bytes -= heard.size
            return heard

    def _take(self, heard: _Heard) -> None:
        recorder, now_ns = self._recorder, heard.now_ns
        if heard.lost:
            recorder.flush(now_ns)
            recorder.lose(heard.lost)
        if heard.overflow:
            recorder.overflow()
        for key, payload in heard.messages:
            recorder.add(now_ns, key, payload)
        if heard.step_s:
            recorder.flush(now_ns)
            recorder.set_clock(heard.step_s)
        else:
            recorder.flush_if_due(now_ns)
