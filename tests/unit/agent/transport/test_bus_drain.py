"""The bus's inboxes: how much of a flood one tick takes."""

from __future__ import annotations

import threading
from itertools import islice
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from handfast.agent.node import INBOX_SIZE
from handfast.agent.transport.bus import Bus
from handfast.agent.transport.link_watch import LinkWatch

SAMPLE = SimpleNamespace(key_expr="two/robot/7/hand", payload=SimpleNamespace(to_bytes=lambda: b"junk"))


class Flooded:
    """A session on which every message that is taken has been followed by another."""

    def declare_subscriber(self, _key: str, _ring: object) -> Any:
        return SimpleNamespace(handler=SimpleNamespace(try_recv=lambda: SAMPLE))


@pytest.mark.parametrize(("sizes", "total"), [((), INBOX_SIZE), ((5,), 5)])
def test_a_flood_costs_no_more_than_an_inbox_of_each_key(
    monkeypatch: pytest.MonkeyPatch, sizes: tuple[int, ...], total: int
):
    monkeypatch.setattr(zenoh, "open", lambda _config: Flooded())
    monkeypatch.setattr("handfast.agent.transport.bus._SESSIONS", [])  # it is none that has links
    bus = Bus(listen=[], connect=[])
    bus.subscribe("two/robot/2/hand", *sizes)
    bus.subscribe("two/**", *sizes)
    taken = list(islice(bus.drain(), 1000))
    assert [key for key, _ in taken] == ["two/robot/2/hand"] * total + ["two/robot/7/hand"] * total


def test_closing_leaves_no_thread_that_the_end_of_the_interpreter_would_meet_in_zenoh(
    monkeypatch: pytest.MonkeyPatch,
):
    begun, ending = threading.Event(), threading.Event()

    class Session:
        """One that is closed as soon as the links that are being opened are looked at."""

        def is_closed(self) -> bool:
            return False

        def close(self) -> None:
            assert begun.wait(10.0)

    def give_up(_watch: LinkWatch, _found: object) -> None:
        begun.set()
        ending.wait(0.3)  # in Zenoh still, when all is closed

    monkeypatch.setattr(zenoh, "open", lambda _config: Session())
    monkeypatch.setattr(LinkWatch, "give_up", give_up)
    before = threading.enumerate()
    Bus(listen=[], connect=[]).close()
    assert threading.enumerate() == before
