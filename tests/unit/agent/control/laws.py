"""Laws of others, for tests: one that works, and one for each mistake."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from handfast.agent.common import plugins
from handfast.agent.common.settings import setting
from handfast.agent.control.own_law import Law, Moment


@dataclass(frozen=True)
class PushSettings:
    """A constant push."""

    push: float = setting(0.0, "Eastwards.", unit="m/s2", ge=-10, le=10)
    mistake: str = setting("", "What goes wrong.")


class Good(Law):
    """Navigation and a push; keeps what it was given."""

    section = "good"
    Settings = PushSettings
    last: Any = None
    restarts = 0

    def restart(self) -> None:
        type(self).restarts += 1

    def acceleration(self, now: Moment) -> tuple[float, float]:
        type(self).last = now
        self.numbers = (float(self.robot), now.time)
        return now.navigation[0] + self.settings.push, now.navigation[1]


class Raises(Law):
    def acceleration(self, now: Moment) -> tuple[float, float]:
        return 1.0 / (now.time - now.time), 0.0


class Late(Law):
    """Well for so long, then a number that is none."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation if now.time < 0.5 else (float("nan"), 0.0)


class Scalar(Law):
    def acceleration(self, now: Moment) -> Any:
        return 3.0


class Text(Law):
    def acceleration(self, now: Moment) -> Any:
        return "12"


class ManyNumbers(Law):
    numbers = (0.0,) * 17

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class NotMade(Law):
    def __init__(self, robot: int, fleet: Any, settings: Any) -> None:
        raise KeyError("gain")

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class HangsMade(Good):
    section = None
    Settings = None

    def __init__(self, robot: int, fleet: Any, settings: Any) -> None:
        time.sleep(30.0)


class HangsModes(Law):
    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation

    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        time.sleep(30.0)


class Cancelled(Law):
    def acceleration(self, now: Moment) -> tuple[float, float]:
        raise asyncio.CancelledError


class Nothing(Law):
    def __new__(cls, *_: Any) -> Any:
        return None

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class Closed(Law):
    """Lets nobody look at it."""

    def __getattribute__(self, name: str) -> Any:
        raise ValueError(f"no {name}")

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class RestartSignature(Law):
    def restart(self, now: Moment) -> None:  # type: ignore[override]
        pass

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class Asynchronous(Law):
    async def acceleration(self, now: Moment) -> tuple[float, float]:  # type: ignore[override]
        return now.navigation


class OwnSignature(Law):
    def __init__(self) -> None:
        pass

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class WrongSignature(Law):
    def acceleration(self) -> tuple[float, float]:  # type: ignore[override]
        return 0.0, 0.0


class WrongInside(Law):
    def acceleration(self, now: Moment) -> Any:
        text: Any = "text"
        return 1 + text


class WithoutMethod(Law):
    pass


class BadRestart(Law):
    def restart(self) -> None:
        raise RuntimeError("not now")

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


class Slow(Law):
    def acceleration(self, now: Moment) -> tuple[float, float]:
        time.sleep(0.015)
        return now.navigation


class Modal(Law):
    """Navigation alone, and says so."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation

    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return [(fleet.control.c1, fleet.control.c2, True)] * 2 * len(fleet.members)


class BadModes(Modal):
    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return [(1.0, float("nan"), True)]


class FewModes(Modal):
    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return [(1.0, 2.0, True)]


class NoLaw:
    def acceleration(self, now: Moment) -> tuple[float, float]:
        return now.navigation


LAWS = {
    kind.__name__: kind
    for kind in (
        Good, Raises, Late, Scalar, Text, ManyNumbers, NotMade, OwnSignature, WrongSignature,
        WrongInside, WithoutMethod, BadRestart, HangsMade, HangsModes, Asynchronous, Slow, Modal, BadModes,
        FewModes, NoLaw, Cancelled, Nothing, Closed, RestartSignature,
    )
}  # fmt: skip


@contextmanager
def known() -> Iterator[None]:
    """A context in which fleet files may name these laws."""
    for name, kind in LAWS.items():
        plugins.register(name, kind)
    Good.last, Good.restarts = None, 0
    try:
        yield
    finally:
        plugins._registered.clear()
