"""An operator's place on the bus of a fleet of which some robots believe another authority than others.

While an authority is being replaced, a robot that has the new one and a robot that still has the one before
have no link with each other, nor with an operator of the other's. So the operator has a bus with credentials
of each: what is said goes out on all of them, sealed with each; what comes on any of them is heard.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Protocol

from handfast.agent.transport.bus import Bus


class Watch(Protocol):
    """Who is there, as `agent.transport.bus.Presence` and `JoinedPresence` tell it."""

    @property
    def alive(self) -> set[str]: ...

    def update(self) -> list[tuple[str, bool]]: ...


class OperatorBus(Protocol):
    """What an operator's commands need of a bus: a `Bus`, or a `JoinedBus`."""

    def __enter__(self) -> OperatorBus: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def close(self) -> None: ...

    def subscribe(self, key: str, size: int | None = None) -> None: ...

    def watch(self, key: str) -> Watch: ...

    def declare(self, key: str) -> None: ...

    def publish(self, key: str, payload: bytes) -> None: ...

    def drain(self) -> Sequence[tuple[str, bytes]]: ...


class JoinedBus:
    """Several buses as one. A context manager.

    Args:
        now: with credentials of the authority of now; None where there are none that can be used.
        earlier: with those of earlier ones.
    """

    def __init__(self, now: Bus | None, earlier: Sequence[Bus]) -> None:
        self._now = now
        self._buses = (*(() if now is None else (now,)), *earlier)

    def __enter__(self) -> JoinedBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes all of them, the last that was opened first; safe to call twice."""
        for bus in reversed(self._buses):
            bus.close()

    def subscribe(self, key: str, size: int | None = None) -> None:
        for bus in self._buses:
            bus.subscribe(key, size)

    def watch(self, key: str) -> JoinedPresence:
        return JoinedPresence([bus.watch(key) for bus in self._buses], 0 if self._now is not None else -1)

    def declare(self, key: str) -> None:
        for bus in self._buses:
            bus.declare(key)

    def publish(self, key: str, payload: bytes) -> None:
        for bus in self._buses:
            bus.publish(key, payload)

    def drain(self) -> Sequence[tuple[str, bytes]]:
        return [each for bus in self._buses for each in bus.drain()]


class JoinedPresence:
    """Who is there on any of several buses. A process has credentials of one authority at a time, so it is on
    the bus on which it came last: who comes on another one is a new process in its place.

    Args:
        parts: by bus.
        now: which of them has the credentials of the authority of now, -1 for none.
    """

    def __init__(self, parts: Sequence[Watch], now: int) -> None:
        self._parts, self._now = parts, now
        self._on: dict[str, int] = {}

    @property
    def alive(self) -> set[str]:
        return set(self._on)

    @property
    def alive_now(self) -> set[str]:
        """Those that have credentials of the authority of now."""
        return {key for key, part in self._on.items() if part == self._now}

    def update(self) -> list[tuple[str, bool]]:
        """As `agent.transport.bus.Presence.update`."""
        changes: list[tuple[str, bool]] = []
        for number, part in enumerate(self._parts):
            for key, here in part.update():
                before = self._on.get(key)
                if here:
                    if before not in (None, number):
                        changes.append((key, False))
                    self._on[key] = number
                elif before != number:
                    continue  # another process is in its place already
                else:
                    del self._on[key]
                changes.append((key, here))
        return changes
