"""handfast.agent.transport.tcp_links: links that come while they are looked at, and those that nothing
happens on."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.transport.link_watch import LinkWatch
from handfast.agent.transport.tcp_links import WHOLE_LOOK_NS, TcpLinks
from handfast.agent.transport.tcp_sockets import TcpSocket

T0 = 1000 * NS_PER_S


class Watch(LinkWatch):
    """Counts whole looks; the first finds that a link is opened in the midst of it."""

    def __init__(self, stack: ExitStack, *, opens: bool) -> None:
        self.server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        host, port = self.server.getsockname()[:2]
        self.endpoint = f"tcp/{host}:{port}"
        self.opened: set[str] = set()
        super().__init__([], [self.endpoint], 1.0, lambda: self.opened)
        self._stack, self._opens, self.looks = stack, opens, 0

    def look(self, found: Sequence[TcpSocket], now_ns: int) -> list[str]:
        deaf = super().look(found, now_ns)
        self.looks += 1
        if self._opens and self.looks == 1:
            self.open()
        return deaf

    def open(self) -> None:
        near = self._stack.enter_context(socket.create_connection(self.server.getsockname()))
        self._stack.enter_context(self.server.accept()[0])
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        self.opened.add("{}:{}".format(*near.getsockname()))


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


def looked(links: TcpLinks, now_ns: int) -> int:
    """Looks when it is due; until when the next is."""
    assert links.due_ns <= now_ns
    assert links.look(now_ns) == []
    assert links.due_ns > now_ns
    return links.due_ns


def test_a_link_that_is_opened_while_others_are_looked_at_is_met_at_the_next_look(stack: ExitStack) -> None:
    watch = Watch(stack, opens=True)
    links = TcpLinks(watch)
    now_ns = looked(links, T0)
    assert not links.reopen(watch.endpoint), "it is not known yet"
    looked(links, now_ns)
    assert links.reopen(watch.endpoint)


def test_one_that_is_opened_later_is_too(stack: ExitStack) -> None:
    watch = Watch(stack, opens=False)
    links = TcpLinks(watch)
    now_ns = looked(links, looked(links, T0))
    watch.open()
    looked(links, now_ns)
    assert links.reopen(watch.endpoint)


def test_where_nothing_changes_they_are_looked_at_one_by_one_at_times(stack: ExitStack) -> None:
    watch = Watch(stack, opens=False)
    links, now_ns = TcpLinks(watch), T0
    while now_ns < T0 + WHOLE_LOOK_NS:
        now_ns = looked(links, now_ns)
    assert watch.looks == 1
    looked(links, now_ns)
    assert watch.looks == 2
