"""Serves a running fleet to Foxglove, to this machine alone, for looking only."""

from __future__ import annotations

import ipaddress
import json
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

from handfast.agent.common.errors import Error, packages_named
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import Message
from handfast.deploy.console.data_files import FOXGLOVE_LAYOUT
from handfast.deploy.recording.foxglove.channels import Channels
from handfast.deploy.recording.foxglove.schemas import LOG, PLOTS, SCHEMAS, TOPICS

if TYPE_CHECKING:
    from foxglove.websocket import ChannelView, Client

PORT: Final = 8765
"""Where Foxglove looks for a server unless it is told another port."""
LOOPBACK: Final = "127.0.0.1"
BACKLOG: Final = 256
"""So many messages wait for one viewer, some seconds of them: of a slow one the oldest are dropped."""

_OVER_TIME: Final = frozenset({PLOTS, LOG})
"""Topics of which a message that is sent twice is shown twice."""


class ServeError(Error):
    """The fleet cannot be served to Foxglove; the text says why."""


def layout_path() -> Path:
    """The layout that comes with the program, to be imported by Foxglove: for live and recorded fleets."""
    return FOXGLOVE_LAYOUT


class FoxgloveServer:
    """A server of the Foxglove WebSocket protocol, from when it is made until `close`.

    It offers channels and nothing else: no services, no parameters, no publishing by clients. It answers in
    threads of its own; a viewer that does not keep up misses messages, and `feed` does not wait for it.

    Args:
        fleet: what is shown.
        port: 0 for any that is free.
        host: a loopback address.

    Attributes:
        port: where it is served.

    Raises:
        ServeError: it would be served to other computers, or the port is taken.
        handfast.agent.common.errors.MissingPackageError: foxglove-sdk is not installed.
    """

    def __init__(self, fleet: Fleet, port: int = PORT, *, host: str = LOOPBACK) -> None:
        if not _is_loopback(host):
            raise ServeError(
                f"cannot serve Foxglove on {host}, only on this machine ({LOOPBACK}): the server asks nobody "
                "who he is, and whoever reaches that address could watch the fleet. From another computer go "
                f"through ssh: ssh -L {port}:{LOOPBACK}:{port} THIS_MACHINE"
            )
        with packages_named("a server for Foxglove"):
            import foxglove
            from foxglove.websocket import ServerListener
        self._derived = Channels(fleet)
        self._joined: deque[str] = deque()
        """Topics that a viewer has just begun to look at."""
        self._last: dict[str, bytes] = {}
        context = self._context = foxglove.Context()  # without it the channels are gone
        joined = self._joined

        class Listener(ServerListener):
            def on_subscribe(self, client: Client, channel: ChannelView) -> None:
                joined.append(channel.topic)  # in a thread of the server's

        self._channels = {
            topic: foxglove.Channel(
                topic,
                message_encoding="json",
                schema=foxglove.Schema(
                    name=name, encoding="jsonschema", data=json.dumps(SCHEMAS[name]).encode()
                ),
                context=context,
            )
            for topic, name in TOPICS.items()
        }
        try:
            self._server = foxglove.start_server(
                name=f"handfast {fleet.fleet.name}",
                host=host,
                port=port,
                capabilities=[],
                server_listener=Listener(),
                context=context,
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            why = str(error).removeprefix("FoxgloveError: ").partition(" (os error")[0]
            raise ServeError(
                f"cannot serve Foxglove on {host} port {port}: {why}; give another port"
            ) from None
        self.port: Final[int] = self._server.port
        self._host = f"[{host}]" if ":" in host else host

    @property
    def address(self) -> str:
        """What to open in Foxglove, as "Foxglove WebSocket"."""
        return f"ws://{self._host}:{self.port}"

    def feed(self, now_ns: int, key: str, message: Message) -> None:
        """Takes one message of the fleet, and shows what comes of it. To be called by one thread.

        Args:
            now_ns: when it came, wall clock.
            key: on which it came.
        """
        while self._joined:
            # What does not change is not said again, and the server keeps nothing: who comes later is told
            # here. To the others, who hear it twice, it changes nothing.
            topic = self._joined.popleft()
            if topic in self._last:
                self._channels[topic].log(self._last[topic], log_time=now_ns)
        for topic, _, content in self._derived.feed(now_ns, key, message):
            if topic not in _OVER_TIME:
                self._last[topic] = content
            self._channels[topic].log(content, log_time=now_ns)

    def close(self) -> None:
        """Ends it. What is fed later is shown to nobody."""
        self._server.stop()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
