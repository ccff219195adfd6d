"""Several buses as one, while an authority is being replaced."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from handfast.deploy.session.joined_bus import JoinedBus, JoinedPresence

AGENT, PLANT = "t/robot/1/alive/agent", "t/robot/1/alive/plant"


class Part:
    """A bus, and who is on it."""

    def __init__(self, name: str = "", log: list[tuple[str, Any]] | None = None) -> None:
        self.name = name
        self.log: list[tuple[str, Any]] = [] if log is None else log
        self.waiting: list[tuple[str, bytes]] = []
        self.news: list[tuple[str, bool]] = []
        self.alive: set[str] = set()

    def update(self) -> list[tuple[str, bool]]:
        news, self.news = self.news, []
        return news

    def close(self) -> None:
        self.log.append(("close", self.name))

    def subscribe(self, key: str, size: int) -> None:
        self.log.append(("subscribe", (self.name, key)))

    def declare(self, key: str) -> None:
        self.log.append(("declare", (self.name, key)))

    def publish(self, key: str, payload: bytes) -> None:
        self.log.append(("publish", (self.name, key, payload)))

    def drain(self) -> Iterator[tuple[str, bytes]]:
        yield from self.waiting
        self.waiting.clear()

    def watch(self, key: str) -> Part:
        return self


def test_what_is_said_goes_out_on_all_and_what_comes_on_any_is_heard() -> None:
    log: list[tuple[str, Any]] = []
    now, before = Part("now", log), Part("before", log)
    with JoinedBus(now, [before]) as bus:  # type: ignore[arg-type,list-item]
        bus.subscribe("k")
        bus.declare("stop")
        bus.publish("stop", b"1")
        now.waiting, before.waiting = [("k", b"a")], [("k", b"b")]
        assert list(bus.drain()) == [("k", b"a"), ("k", b"b")]
        assert list(bus.drain()) == []
    assert log == [
        ("subscribe", ("now", "k")),
        ("subscribe", ("before", "k")),
        ("declare", ("now", "stop")),
        ("declare", ("before", "stop")),
        ("publish", ("now", "stop", b"1")),
        ("publish", ("before", "stop", b"1")),
        ("close", "before"),
        ("close", "now"),
    ]


def test_a_process_that_takes_anothers_place_is_another() -> None:
    now, before = Part(), Part()
    presence = JoinedPresence([now, before], 0)
    before.news = [(AGENT, True), (PLANT, True)]
    assert presence.update() == [(AGENT, True), (PLANT, True)]
    assert (presence.alive, presence.alive_now) == ({AGENT, PLANT}, set())
    now.news = [(AGENT, True)]  # it starts again with new credentials, sooner than it is seen to be gone
    assert presence.update() == [(AGENT, False), (AGENT, True)]
    before.news = [(AGENT, False)]
    assert presence.update() == []
    assert (presence.alive, presence.alive_now) == ({AGENT, PLANT}, {AGENT})
    before.news, now.news = [(PLANT, False)], [(PLANT, True)]
    assert presence.update()[-1] == (PLANT, True)
    now.news = [(AGENT, False), (AGENT, True), (AGENT, False)]
    assert presence.update() == [(AGENT, False), (AGENT, True), (AGENT, False)]
    assert presence.alive == presence.alive_now == {PLANT}


def test_without_credentials_of_now_nobody_has_them() -> None:
    before = Part()
    presence = JoinedBus(None, [before]).watch("*")  # type: ignore[list-item]
    before.news = [(AGENT, True)]
    presence.update()
    assert (presence.alive, presence.alive_now) == ({AGENT}, set())
