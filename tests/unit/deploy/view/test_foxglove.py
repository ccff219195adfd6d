"""A fleet served to Foxglove: by its protocol, for looking only, to this machine; and the layout for it."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect

from handfast.agent.common.errors import MissingPackageError
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import PlantState
from handfast.deploy.recording.foxglove.schemas import LOG, POSES, ROBOTS, SCHEMAS, TOPICS
from handfast.deploy.view.foxglove import BACKLOG, PORT, FoxgloveServer, ServeError, layout_path
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, in_formation, make_fleet, messages, triangle

FLEET = make_fleet(*triangle(2), duration_s=1.0, velocity=(0.3, 0.0))
SENT = list(messages(FLEET, in_formation(FLEET)))
WITHIN_S = 10.0


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    made = FoxgloveServer(FLEET, 0)
    yield made
    made.close()


class Viewer:
    """What Foxglove does at the other end."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}

    async def begin(self) -> None:
        self.info = await self.said()
        while len(self.channels) < len(TOPICS):
            said = await self.said()
            assert said["op"] == "advertise"
            self.channels |= {each["topic"]: each for each in said["channels"]}

    async def said(self) -> dict[str, Any]:
        text = await asyncio.wait_for(self._connection.recv(), WITHIN_S)
        assert isinstance(text, str)
        answer: dict[str, Any] = json.loads(text)
        return answer

    async def say(self, **what: Any) -> None:
        await self._connection.send(json.dumps(what))

    async def subscribe(self, *topics: str) -> None:
        ids = [{"id": k, "channelId": self.channels[topic]["id"]} for k, topic in enumerate(topics)]
        await self.say(op="subscribe", subscriptions=ids)

    async def message(self) -> tuple[int, int, Any]:
        """Number of the subscription, time (ns) and content of the next message."""
        data = await asyncio.wait_for(self._connection.recv(), WITHIN_S)
        assert isinstance(data, bytes)
        kind, subscription, log_ns = struct.unpack_from("<BIQ", data)
        assert kind == 1
        return subscription, log_ns, json.loads(data[13:])

    async def rest(self) -> list[tuple[int, int, Any]]:
        """The messages that come until none does for a while."""
        found = []
        with suppress(TimeoutError):
            while True:
                found.append(await asyncio.wait_for(self.message(), 0.3 if found else WITHIN_S))
        return found


def look(server: FoxgloveServer, then: Callable[[Viewer], Awaitable[None]]) -> None:
    async def run() -> None:
        protocol: Any = "foxglove.sdk.v1"
        async with connect(server.address, subprotocols=[protocol], close_timeout=0.5) as connection:
            assert connection.subprotocol == protocol
            viewer = Viewer(connection)
            await viewer.begin()
            await then(viewer)

    asyncio.run(run())


async def feed(server: FoxgloveServer, sent: list[Sent]) -> None:
    for each in sent:
        server.feed(*each)
        await asyncio.sleep(0)


async def joined(server: FoxgloveServer, topics: int) -> None:
    """Waits until the server knows of so many topics that a viewer looks at."""
    end_s = time.monotonic() + WITHIN_S
    while len(server._joined) < topics:
        assert time.monotonic() < end_s
        await asyncio.sleep(0.01)


def test_foxglove_is_offered_channels_and_nothing_else(server: FoxgloveServer) -> None:
    async def then(viewer: Viewer) -> None:
        assert viewer.info["op"] == "serverInfo"
        assert viewer.info["name"] == "handfast made-up"
        assert viewer.info["capabilities"] == []
        assert not viewer.info.get("supportedEncodings")
        assert {topic: each["schemaName"] for topic, each in viewer.channels.items()} == TOPICS
        for each in viewer.channels.values():
            assert (each["encoding"], each["schemaEncoding"]) == ("json", "jsonschema")
            assert json.loads(each["schema"]) == SCHEMAS[each["schemaName"]]
        asked: tuple[dict[str, Any], ...] = (
            {"op": "advertise", "channels": [{"id": 1, "topic": "/a", "encoding": "json", "schemaName": ""}]},
            {"op": "setParameters", "parameters": [{"name": "a", "value": 1}]},
        )
        for what in asked:
            await viewer.say(**what)
            answer = await viewer.said()
            assert (answer["op"], answer["level"]) == ("status", 2), "an error"
            assert "does not support" in answer["message"]

    look(server, then)


def test_who_looks_sees_what_is_fed(server: FoxgloveServer) -> None:
    async def then(viewer: Viewer) -> None:
        await viewer.subscribe(ROBOTS, POSES, LOG)
        await joined(server, 3)
        await feed(server, SENT)
        seen: list[list[Any]] = [[], [], []]
        while len(seen[1]) < 12 or len(seen[2]) < 4:
            subscription, log_ns, content = await viewer.message()
            seen[subscription].append((log_ns, content))
        robots, poses, log = seen
        assert len(robots) == 1
        assert len(robots[0][1]["entities"]) == 3
        assert len({log_ns for log_ns, _ in poses}) == len(poses)
        assert {len(content["transforms"]) for _, content in poses[3:]} == {4}
        assert {content["message"] for _, content in log} == {"mission: a drive of 1 s", "running"}

    look(server, then)


def test_a_viewer_that_reads_nothing_delays_nobody() -> None:
    """Neither what waits for it nor the operating system's buffers hold all of this: some 10 MB."""
    fleet = make_fleet(*triangle(8))
    server = FoxgloveServer(fleet, 0)
    still = (*(0.0,) * 7, True, True, True, "")

    async def then(viewer: Viewer) -> None:
        await viewer.subscribe(POSES)
        await joined(server, 1)
        took_s = []
        for k in range(5 * BACKLOG):
            robot, now_ns = 1 + k % len(fleet.robots), EPOCH_NS + k * 100_000_000
            state = PlantState(robot, k, now_ns, *still)._replace(x=float(k))
            begin_s = time.perf_counter()
            server.feed(now_ns, key_expressions.plant_state("made-up", robot), state)
            took_s.append(time.perf_counter() - begin_s)
        assert sorted(took_s)[len(took_s) * 99 // 100] < 0.05

    look(server, then)
    server.close()


def test_a_taken_port_and_another_address_are_refused_in_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ServeError, match=rf"127\.0\.0\.1 port {port}: .*in use; give another port$"):
            FoxgloveServer(FLEET, port)
    for host in ("0.0.0.0", "192.168.1.7", "robots.example", "::"):
        with pytest.raises(
            ServeError, match=r"only on this machine .* nobody who he is.*ssh -L 8765"
        ) as error:
            FoxgloveServer(FLEET, host=host)
        assert "\n" not in str(error.value)


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(MissingPackageError, match=r"foxglove: pip install 'handfast\[foxglove\]'"):
        FoxgloveServer(FLEET, 0)


def test_the_layout_names_topics_that_there_are_and_fields_of_theirs() -> None:
    layout = json.loads(layout_path().read_text("utf-8"))
    panels = layout["configById"]
    kinds = sorted(panel.partition("!")[0] for panel in panels)
    assert kinds == ["3D", "DiagnosticSummary", "Plot", "Plot", "RosOut"]

    def arranged(part: Any) -> set[str]:
        return {part} if isinstance(part, str) else arranged(part["first"]) | arranged(part["second"])

    assert arranged(layout["layout"]) == set(panels)
    drawn = panels["3D!handfast"]
    assert set(drawn["topics"]) == {topic for topic, name in TOPICS.items() if name == "foxglove.SceneUpdate"}
    assert (drawn["followTf"], drawn["fixedFrame"]) == ("formation", "world")
    assert TOPICS[panels["DiagnosticSummary!robots"]["topicToRender"]] == "diagnostic_msgs/DiagnosticArray"
    assert TOPICS[panels["RosOut!log"]["topicToRender"]] == "foxglove.Log"
    series = [path for name, panel in panels.items() if name.startswith("Plot!") for path in panel["paths"]]
    for path in series:
        topic, _, field = path["value"].partition(".")
        described = SCHEMAS[TOPICS[topic]]["properties"][field]
        if "dynamicValueField" in path:
            inside = described["items"]["properties"]
            assert {path["dynamicLabelField"], path["dynamicValueField"]} <= set(inside)
        else:
            assert described["type"] == "number"
    assert PORT == 8765
