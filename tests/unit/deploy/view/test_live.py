"""The server of a running fleet's page: what can be ordered there, and what it is when the drive is over."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.asyncio.client import connect

from handfast.agent.fleet.model import Fleet
from handfast.agent.transport.bus import Bus
from handfast.deploy.view.live import LiveServer
from handfast.deploy.view.live_fleet import LiveFleet
from handfast.deploy.view.server import TALK_PATH, Content
from tests.unit.deploy.view.running import FLEET, HeldBus, Running
from tests.unit.deploy.view.test_controls import VALUES
from tests.unit.deploy.view.test_orders import Way, begun

KINDS = ["stop", "resume", "join", "leave", "replace", "remove", "reshape", "move", "fault", "heal"]


class Served(Running):
    """A running fleet with the server of its page."""

    server: LiveServer

    def __init__(self, **options: Any) -> None:
        options.setdefault("ways", lambda: [Way()])

        def make(fleet: Fleet, bus: Bus) -> LiveFleet:
            self.server = LiveServer(fleet, bus, **options)
            return self.server.live

        super().__init__(make=make)
        self.come()
        begun(self)

    def part(self, name: str) -> Any:
        return json.loads(self.live.parts[name][1])

    def order(self, **content: Any) -> dict[str, Any]:
        """What is told of an order at once."""
        assert self.server.controls is not None
        self.server.controls.take({"seen_s": self.clock.ns / 1e9, **content})
        found: dict[str, Any] = self.part("orders")[-1]
        return found

    def frame(self) -> None:
        self.clock.ns += 50_000_000
        self.server.pages.step()


@contextmanager
def serving(**options: Any) -> Iterator[Served]:
    made = Served(**options)
    try:
        yield made
    finally:
        made.server.close()


@pytest.fixture
def served() -> Iterator[Served]:
    with serving() as made:
        yield made


def test_a_page_is_told_what_can_be_ordered() -> None:
    with serving() as served:
        assert served.part("controls") == KINDS
    with serving(source="a fleet.toml") as served:
        assert served.part("controls") == [*KINDS, "start"]
    with serving(ways=None) as served:
        assert served.part("controls") == []
        assert served.server.controls is None
        served.frame()


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([("move", "by"), ("fault", "rule")]), st.data())
def test_whatever_a_page_says_of_them_is_given_or_refused(
    served: Served, kind: tuple[str, str], data: st.DataObject
) -> None:
    names = st.sampled_from(["1", "2", "3", "4", "7", "link", "robot", "loss", "delay", "for"])
    content = data.draw(VALUES | st.dictionaries(names, VALUES, max_size=4))
    served.bus.said.clear()
    about = served.order(id=str(served.number()), kind=kind[0], **{kind[1]: content})
    assert ("count" in about) == bool(served.bus.said)
    if "count" not in about:
        assert len(about["lines"]) == 1


def test_when_the_drive_is_over_pages_keep_what_they_have(served: Served) -> None:
    served.frame()
    number, t_s = served.live.number, served.live.t_s
    served.server.end()
    assert (served.live.number, served.part("over")) == (number + 1, True)
    served.frame()
    served.server.end()
    assert (served.live.number, served.live.t_s) == (number + 1, t_s)


def test_then_they_get_the_recording(served: Served) -> None:
    served.frame()
    number = served.live.number
    answers: list[str] = []

    def answer(path: str) -> Content | None:
        answers.append(path)
        return None

    served.server.show(answer)
    assert served.part("over")
    assert served.part("reload")
    assert served.live.number > number
    assert served.server._server.answer is answer


def test_a_port_that_is_taken_is_said_and_nothing_left_open(served: Served) -> None:
    taken = int(served.server.address.partition("#")[0].rstrip("/").rpartition(":")[2])
    with pytest.raises(OSError, match="in use"):
        LiveServer(FLEET, HeldBus(), None, taken)


def test_it_serves_until_it_is_cancelled(served: Served) -> None:
    async def main() -> None:
        task = asyncio.create_task(served.server.serve())
        address, _, token = served.server.address.partition("#token=")
        origin: Any = address.rstrip("/")
        async with connect(f"ws{address.removeprefix('http')}{TALK_PATH}", origin=origin) as page:
            await page.send(json.dumps({"token": token}))
            told = json.loads(await asyncio.wait_for(page.recv(), 20))
            assert told["parts"]["controls"] == KINDS
            assert isinstance(await asyncio.wait_for(page.recv(), 20), bytes)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        assert not len(served.server.pages)

    asyncio.run(main())
