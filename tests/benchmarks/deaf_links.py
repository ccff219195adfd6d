"""Links that stand and are never read from, and what looking for them costs.

Processes that listen and processes that connect to all of them, each with a `Bus` as a robot has it, beside
busy loops; every link carries ten messages a second each way. All are judged at one time, so long after the
last of them has opened its bus, and none ends before all were. A direction is deaf where nothing has come for
1.5 s over a link that stands; one whose link is not there is counted beside it. Zenoh's own limit for opening
a link is set so short that it runs out between the start of sending and that of reading
(`agent.transport.link_watch`): without the watch, with it, and as robots have it.
"""

from __future__ import annotations

import json
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.transport import bus as robots_bus
from agent.transport.bus import Bus
from agent.transport.link_watch import PERIOD_NS, LinkWatch
from agent.transport.tcp_linger import Lingering
from agent.transport.tcp_sockets import TcpSockets
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.processes import BenchmarkError, environment

BASE_PORT: Final = 21_000
SHORT_MS: Final = 15
SILENT_S: Final = 1.5
PERIOD_S: Final = 0.1
LINKS: Final = 100
LOOKS: Final = 200


def main() -> None:
    """One of the processes; once it is asked, prints how many others it does not hear over links that stand,
    how many without one, and how many links were opened anew; ends when its input does."""
    order = json.loads(sys.argv[1])
    if order["open_timeout_ms"]:
        _shorten(order["open_timeout_ms"])
    me, half = order["me"], order["count"] // 2
    opens = me >= half
    endpoints = [f"tcp/127.0.0.1:{BASE_PORT + k}" for k in range(half)]
    listen = [f"tcp/127.0.0.1:{BASE_PORT + me}"]
    bus = Bus(listen=listen, connect=endpoints if opens else [], link_timeout_s=0.4)
    if not order["watch"]:
        bus._links._watch.look = lambda *_: []  # type: ignore[method-assign]
    bus.subscribe("all/*")
    bus.declare(f"all/{me}")
    heard: dict[str, float] = {}
    anew = 0
    others = range(half) if opens else range(half, 2 * half)
    print(flush=True)
    while True:
        asked = select.select([sys.stdin], [], [], PERIOD_S)[0]
        bus.publish(f"all/{me}", bytes(100))
        for key, _ in bus.drain():
            heard[key] = time.monotonic()
        anew += len(bus.were_deaf())
        if asked:
            if not sys.stdin.readline():
                os._exit(0)
            silent = [k for k in others if time.monotonic() - heard.get(f"all/{k}", 0.0) > SILENT_S]
            # Who accepts a link cannot see whose it is: there all of them stand, or as many fewer do.
            ends = [str(link.dst) for link in bus._near.info.links()]
            absent = len([k for k in silent if endpoints[k] not in ends]) if opens else half - len(ends)
            print(json.dumps([len(silent) - absent, absent, anew]), flush=True)


def _shorten(open_timeout_ms: int) -> None:
    settings_of = robots_bus.settings_of

    def shorter(*given: Any) -> dict[str, Any]:
        return settings_of(*given) | {"transport/unicast/open_timeout": open_timeout_ms}

    robots_bus.settings_of = shorter  # type: ignore[assignment]


class Counts(NamedTuple):
    """Deaf directions at those that open links and at those that accept them; links that are not there, of
    those that were to be opened; links opened anew."""

    openers: int
    listeners: int
    absent: int
    anew: int


def _deaf(count: int, busy: int, seconds: float, **order: Any) -> Counts:
    with ExitStack() as stack:
        for _ in range(busy):
            loop = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(loop.wait)
            stack.callback(loop.kill)
        processes = []
        for me in range(count):
            whole = json.dumps(order | {"me": me, "count": count})
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.benchmarks.deaf_links", whole],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment(),
                text=True,
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            processes.append(process)
        _told(processes)  # every one is up
        time.sleep(seconds)
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        rows = [json.loads(each) for each in _told(processes)]
    listeners, openers = rows[: count // 2], rows[count // 2 :]
    return Counts(
        sum(row[0] for row in openers),
        sum(row[0] for row in listeners),
        sum(row[1] for row in openers),
        sum(row[2] for row in rows),
    )


def _told(processes: Sequence[subprocess.Popen[str]]) -> list[str]:
    """The next line of each."""
    lines = []
    for process in processes:
        assert process.stdout is not None
        lines.append(process.stdout.readline())
    if not all(lines):
        raise BenchmarkError("one of the processes has failed")
    return lines


def _look_cpu_s() -> float:
    """CPU of one look at `LINKS` links on which nothing waits, s."""
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=LINKS))
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        opened = set()
        near = TcpSockets().look() or ()
        for _ in range(LINKS):
            link = stack.enter_context(socket.create_connection(server.getsockname()))
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            opened.add(f"127.0.0.1:{link.getsockname()[1]}")
        sockets, lingering = TcpSockets(), Lingering()
        lingering._done.update(each.inode for each in sockets.look() or () if each not in near)
        watch = LinkWatch([], [endpoint], 1.0, lambda: opened)
        for k in range(4):
            watch.look(sockets.look() or (), k * PERIOD_NS)
        begun = time.process_time()
        for k in range(LOOKS):
            found = sockets.look() or ()
            lingering.end(found)
            watch.look(found, (4 + k) * PERIOD_NS)
        return (time.process_time() - begun) / LOOKS


def run(options: Options) -> Result:
    count, seconds = (40, 15.0) if options.quick else (60, 30.0)
    result, rows = Result([]), []
    for what, open_timeout_ms, watch in (
        (f"{SHORT_MS} ms, not watched", SHORT_MS, False),
        (f"{SHORT_MS} ms, watched", SHORT_MS, True),
        ("as robots have it", 0, True),
    ):
        found = _deaf(count, 12, seconds, open_timeout_ms=open_timeout_ms, watch=watch)
        links = str((count // 2) ** 2)
        rows.append([what, *map(str, (found.openers, found.listeners)), links, *map(str, found[2:])])
    result.figures += [
        Figure("deaf directions as robots have it", found.openers + found.listeners, "", 0),
        Figure("links that are not there, as robots have it", found.absent, "", 0),
    ]
    share = _look_cpu_s() / (PERIOD_NS / NS_PER_S)
    result.figures.append(Figure(f"CPU of looking at {LINKS} links", 100.0 * share, "%", 0.2))
    heading = ["Zenoh's limit", "deaf: openers", "listeners", "of each", "not there", "opened anew"]
    result.details += table(heading, rows)
    return result


if __name__ == "__main__":
    main()
