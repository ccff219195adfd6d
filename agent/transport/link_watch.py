"""Shuts links down that do not come to be, and links on which nothing is read, so that Zenoh opens them anew.

Both are seen in the kernel, which knows of every socket how many bytes came, and how many of them wait.

A link that is not open in time: a frozen process accepts connections but does not answer, and of a peer that
is out of reach the first packet is lost, and not sent again for a second. Zenoh has a limit for that, which
must not run out: where it does between the start of sending on a link and that of reading from it, the link
stands, and is never read from. Measured, with 0.3 s and two cores that are busy: 8 of 900 directions of
links dead for good, always at the side that had opened the link; with 15 ms 241 of 400.

A deaf link, whatever has made it one: bytes wait, nobody reads them, and yet this process sends on it, as it
does `KEEP_ALIVES` times in a lease (`agent.transport.bus`). So it runs, and has the link for one of its
own, which what knocks at its port is not. Where its threads have to wait for a processor, they read late from
links with which nothing is wrong: the longer they wait, the later a link is deaf. A router of 200 robots on
two cores had shut 78 of its links down in a start, and had to do their declarations again.

How long the threads of this process were ready to run and had no processor.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.transport.tcp_sockets import TcpSocket, borrowed, held, info_of, waiting_on

_TASKS: Final = Path("/proc/self/task")


def run_delay_ns() -> int:
    """Of all its threads that run now together, since each began, ns: the second figure of
    ``/proc/PID/task/TID/schedstat`` (Documentation/scheduler/sched-stats.rst of Linux). 0 where the kernel
    does not say."""
    found = 0
    with suppress(OSError):
        for thread in os.listdir(_TASKS):
            # It has ended meanwhile, or the kernel says something else there.
            with suppress(OSError, IndexError, ValueError):
                found += int((_TASKS / thread / "schedstat").read_text().split()[1])
    return found


PERIOD_NS: Final = NS_PER_S // 2
"""How often all links are looked at."""
SOON_NS: Final = NS_PER_S // 10
"""While links are opened or lacking, or something has waited on one since the last look."""
UNSURE_NS: Final = NS_PER_S // 2
"""A socket to one of the endpoints that has not become a link of Zenoh's for so long is somebody else's."""
DEAF_NS: Final = 3 * NS_PER_S // 4
"""So long nothing is read from a deaf link."""
SUSPECTED_NS: Final = DEAF_NS // 3
"""After so long it is looked at how long this process waits for a processor."""
STARVED_TIMES: Final = 8
"""A process whose threads wait for one all the time, together, gives a link so many times as long, and its
part of that where they wait for a part of the time."""
PATIENCE_MAX: Final = 4
"""Whoever lets this process connect and does not answer is given so many times as long, in the end."""
STALLED_MAX: Final = 2
STALLED_PART: Final = 8
"""Nothing is read from more links than this at a time, or than one in so many: then none of them is deaf."""
SENT_LOOKS: Final = 2
"""At so many looks meanwhile something more has been sent on it: one answer is not enough."""
PAUSED_NS: Final = NS_PER_S // 2
"""A look that comes so much later than it was due is of a process that did not run, or not as it should:
nothing can be said of that time."""
_ESTABLISHED, _SYN_SENT = 1, 2
_ENDPOINT: Final = re.compile(r"[a-z]+/(.+):(\d+)")
_TABLES: Final = Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6")


class _Link:
    """What is known of one socket.

    Attributes:
        endpoint: what this process connected to, "" for a link that was opened to it.
        near: its own address, as Zenoh writes it.
        is_dialling: whether it is not connected yet.
        is_open: whether Zenoh has it for a link.
        read: bytes that were read from it.
        since_ns: when these were seen to become more; of a link that is not open: or when it was begun.
        acked, sent: bytes that its peer has taken, and at how many looks since then these were more.
        suspected: when nothing had been read for a while, and for how long this process had waited for a
            processor by then.
    """

    __slots__ = (
        "acked",
        "endpoint",
        "is_dialling",
        "is_open",
        "near",
        "read",
        "sent",
        "since_ns",
        "suspected",
    )

    def __init__(self, endpoint: str, near: str, since_ns: int) -> None:
        self.endpoint, self.near, self.since_ns = endpoint, near, since_ns
        self.is_open, self.is_dialling = not endpoint, False
        self.read = self.acked = self.sent = 0
        self.suspected: tuple[int, int] | None = None

    def begin(self, now_ns: int) -> None:
        """Something was read from it, or nothing can be said of the time before."""
        self.since_ns, self.sent, self.suspected = now_ns, 0, None


class LinkWatch:
    """The links of one bus.

    Args:
        listen, connect: its endpoints, as Zenoh writes them.
        timeout_s: a link on which nothing new comes for so long while it is opened is shut down; for one that
            is connected, when that was so before, some times as long.
        opened: own addresses (``HOST:PORT``) of all links of this process that are open.
        one_of: endpoints to one of which there should be a link at any time.
        waited_ns: for how long the threads of this process have waited for a processor, together, ns.

    Attributes:
        period_ns: when to look again.
        calm: its links, where nothing waits on any for longer, none is being opened, and none lacks; else
            None.
    """

    def __init__(
        self,
        listen: Iterable[str],
        connect: Iterable[str],
        timeout_s: float,
        opened: Callable[[], Collection[str]],
        one_of: Collection[str] = (),
        waited_ns: Callable[[], int] = run_delay_ns,
    ) -> None:
        self._waited_ns = waited_ns
        self._one_of = frozenset(one_of)
        self._ports = {port for _, port in map(_parts, listen)}
        self._connect = [(*_parts(endpoint), endpoint) for endpoint in connect]
        self._timeout_ns = round(timeout_s * NS_PER_S)
        self._opened = opened
        self._links: dict[int, _Link | None] = {}
        self._shut_down: dict[str, int] = {}
        self._unsure: dict[int, int] = {}
        """Of sockets of which it was too early to say whether they are links: when they were met first."""
        self._looked_ns = 0
        self.period_ns = PERIOD_NS
        self.calm: list[TcpSocket] | None = None

    def look(self, found: Sequence[TcpSocket], now_ns: int) -> list[str]:
        """Looks at all links; returns the endpoints of those that were deaf and are shut down, "" for one
        that was opened to this process.

        Args:
            found: the TCP sockets of this process.
            now_ns: of a clock that is never set.
        """
        before, self._links = self._links, {}
        unsure, self._unsure = self._unsure, {}
        if now_ns - self._looked_ns > self.period_ns + PAUSED_NS:
            for paused in filter(None, before.values()):
                paused.begin(now_ns)
        self._looked_ns = now_ns
        deaf: list[tuple[TcpSocket, _Link]] = []
        opening: list[tuple[TcpSocket, _Link]] = []
        waits, stalled = False, 0
        calm: list[TcpSocket] = []
        for each in found:
            with suppress(OSError):  # closed meanwhile
                if each.inode in before:
                    link = before[each.inode]
                else:
                    self._unsure[each.inode] = unsure.get(each.inode, now_ns)
                    link = self._meet(each, now_ns)
                    del self._unsure[each.inode]
                self._links[each.inode] = link
                if link is None:
                    continue
                waiting = waiting_on(each.number)
                if link.is_open and not waiting:
                    link.since_ns = 0
                    calm.append(each)
                    continue
                if self._is_deaf(each, link, waiting, now_ns):
                    deaf.append((each, link))
                elif not link.is_open:
                    opening.append((each, link))
                # Something waits to be read on every link at times: what has been read since is no matter.
                if link.is_open and link.since_ns == now_ns:
                    calm.append(each)
                else:
                    waits = True
                    stalled += link.is_open
        if opening:
            self._look_at_opening(opening, now_ns)
        self._plan(calm, waits=waits or bool(self._unsure))
        if stalled > max(STALLED_MAX, len(found) // STALLED_PART):
            return []  # nothing is wrong with so many: what reads them all has no time
        for each, _ in deaf:
            with suppress(OSError):
                _shut(each)
        return [link.endpoint for _, link in deaf]

    def _plan(self, calm: list[TcpSocket], *, waits: bool) -> None:
        """Decide when to look again: soon while a link `waits` for something, or the one that there should be
        lacks."""
        links = [link for link in self._links.values() if link is not None]
        if self._one_of and not waits:
            waits = all(link.endpoint not in self._one_of for link in links)
        self.period_ns = SOON_NS if waits else PERIOD_NS
        self.calm = calm if not waits and len(calm) == len(links) else None

    def still_calm(self, now_ns: int) -> None:
        """Takes that nothing has changed since a look that found it `calm`."""
        self._looked_ns = now_ns

    def reopen(self, endpoint: str, found: Sequence[TcpSocket]) -> bool:
        """Shuts down the link to `endpoint` among these; whether there was one that was open."""
        for each in found:
            link = self._links.get(each.inode)
            if link is not None and link.endpoint == endpoint and link.is_open:
                _shut(each)
                return True
        return False

    def give_up(self, found: Sequence[TcpSocket]) -> None:
        """Shuts down what is not open yet: closing a session waits for it."""
        opened = self._opened()
        for each in found:
            with suppress(OSError):
                link = self._links[each.inode] if each.inode in self._links else self._meet(each, 0)
                if link is not None and not link.is_open and link.near not in opened:
                    _shut(each)

    def _meet(self, which: TcpSocket, now_ns: int) -> _Link | None:
        """What is to be known of a new socket, None where it is no link; raises OSError where it is too
        early to say."""
        with borrowed(which.number) as found:
            if found.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                return None
            host, port = found.getsockname()[:2]
            if port in self._ports:
                return _Link("", "", 0)
            state, last_sent_ms, _, received = info_of(found)
            if state == _SYN_SENT:
                there = _dialled(which.inode)
            else:
                there = found.getpeername()[:2]
                if not found.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY):
                    # Zenoh has it on all of its own, but a moment after they are connected.
                    met_ns = self._unsure.get(which.inode, now_ns)
                    if self._endpoint(*there) and now_ns - met_ns < UNSURE_NS:
                        raise OSError("too early to say")
                    return None
        endpoint = self._endpoint(*there)
        if not endpoint:
            return None
        age_ns = 0 if state == _SYN_SENT or received else last_sent_ms * 1_000_000
        return _Link(endpoint, f"[{host}]:{port}" if ":" in host else f"{host}:{port}", now_ns - age_ns)

    def _endpoint(self, host: str, port: int) -> str:
        """Which endpoint is there, "" for none that is ours. One with a name may be anywhere."""
        for its_host, its_port, endpoint in self._connect:
            if its_port == port and its_host in (host, ""):
                return endpoint
        return ""

    def _is_deaf(self, which: TcpSocket, link: _Link, waiting: int, now_ns: int) -> bool:
        """Whether nothing is read from a link; notes when that was so last."""
        with borrowed(which.number) as found:
            state, _, acked, received = info_of(found)
        link.is_dialling = state == _SYN_SENT
        read = received - waiting
        if read != link.read or not link.since_ns:
            link.read = read
            link.begin(now_ns)
        elif acked != link.acked:
            link.sent += 1
        link.acked = acked
        age_ns = now_ns - link.since_ns
        if not waiting or age_ns < SUSPECTED_NS:
            return False
        if link.suspected is None:
            link.suspected = now_ns, self._waited_ns()
            return False
        if link.sent < SENT_LOOKS or age_ns < DEAF_NS:
            return False
        then_ns, waited_ns = link.suspected
        starved = (self._waited_ns() - waited_ns) / (now_ns - then_ns)
        return age_ns >= DEAF_NS * (1.0 + STARVED_TIMES * min(1.0, starved))

    def _look_at_opening(self, opening: Iterable[tuple[TcpSocket, _Link]], now_ns: int) -> None:
        opened = self._opened()
        for each, link in opening:
            if link.near in opened:
                link.is_open = True
                self._shut_down.pop(link.endpoint, None)
                continue
            times = self._shut_down.get(link.endpoint, 0)
            # What is lost on the way is tried again soon; who is there and slow is given more time.
            patience = 1 if link.is_dialling else min(1 << times, PATIENCE_MAX)
            if now_ns - link.since_ns >= patience * self._timeout_ns:
                self._shut_down[link.endpoint] = times + 1
                _shut(each)


def _shut(which: TcpSocket) -> None:
    with suppress(OSError), held(which) as found:
        found.shutdown(socket.SHUT_RDWR)


def _parts(endpoint: str) -> tuple[str, int]:
    """Address and port of an endpoint; "" for a host that is given by its name."""
    found = _ENDPOINT.match(endpoint)
    if found is None:
        return "", 0
    host = found[1].strip("[]")
    try:
        return str(ip_address(host)), int(found[2])
    except ValueError:
        return "", int(found[2])


def _dialled(inode: int) -> tuple[str, int]:
    """Where a socket that is not connected yet connects to: getpeername(2) does not say. Raises OSError."""
    for table in _TABLES:
        with suppress(FileNotFoundError):  # a kernel without IPv6
            for line in table.read_text().splitlines()[1:]:
                words = line.split()
                if int(words[9]) == inode:
                    host, _, port = words[2].partition(":")
                    return _host(host), int(port, 16)
    raise OSError("it connects to nothing")


def _host(digits: str) -> str:
    """An address in those tables: 32-bit words as this machine has them, in hexadecimal."""
    words = [bytes.fromhex(digits[begin : begin + 8])[::-1] for begin in range(0, len(digits), 8)]
    return str(ip_address(b"".join(words)))
