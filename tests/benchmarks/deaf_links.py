"""Links that stand and are never read from, and what looking for them costs.

Processes that listen and processes that connect to all of them, each with a `Bus` as a robot has it, beside
busy loops; every link carries ten messages a second each way. A direction is deaf where nothing has come for
1.5 s at the end. Zenoh's own limit for opening a link is set so short that it runs out between the start of
sending and that of reading (`agent.runtime.link_watch`): without the watch, with it, and as robots have it.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from typing import Any, Final

from agent.common.time import NS_PER_S
from agent.runtime import bus as robots_bus
from agent.runtime.bus import Bus
from agent.runtime.link_watch import PERIOD_NS, LinkWatch
from agent.runtime.tcp_linger import Lingering
from agent.runtime.tcp_sockets import TcpSockets
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.processes import BenchmarkError, environment

BASE_PORT: Final = 21_000
SHORT_MS: Final = 15
SILENT_S: Final = 1.5
LINKS: Final = 100
LOOKS: Final = 200


def main() -> None:
    """One of the processes; prints how many others it does not hear, and how many links were opened anew."""
    order = json.loads(sys.argv[1])
    if order["open_timeout_ms"]:
        _shorten(order["open_timeout_ms"])
    me, half = order["me"], order["count"] // 2
    opens = me >= half
    endpoints = [f"tcp/127.0.0.1:{BASE_PORT + k}" for k in range(half)]
    listen = [f"tcp/127.0.0.1:{BASE_PORT + me}"]
    bus = Bus(listen=listen, connect=endpoints if opens else [], link_timeout_s=0.4)
    if not order["watch"]:
        bus._watch.look = lambda *_: []  # type: ignore[method-assign]
    bus.subscribe("all/*")
    bus.declare(f"all/{me}")
    heard: dict[str, float] = {}
    anew = 0
    until = time.monotonic() + order["seconds"]
    while time.monotonic() < until:
        time.sleep(0.1)
        bus.publish(f"all/{me}", bytes(100))
        for key, _ in bus.drain():
            heard[key] = time.monotonic()
        anew += len(bus.were_deaf())
    others = range(half) if opens else range(half, 2 * half)
    silent = [k for k in others if time.monotonic() - heard.get(f"all/{k}", 0.0) > SILENT_S]
    print(json.dumps([len(silent), anew]), flush=True)
    os._exit(0)


def _shorten(open_timeout_ms: int) -> None:
    settings_of = robots_bus.settings_of

    def shorter(*given: Any) -> dict[str, Any]:
        return settings_of(*given) | {"transport/unicast/open_timeout": open_timeout_ms}

    robots_bus.settings_of = shorter  # type: ignore[assignment]


def _deaf(count: int, busy: int, **order: Any) -> tuple[int, int, int]:
    """Deaf directions at those that open links and at those that accept them; links opened anew."""
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
                stdout=subprocess.PIPE,
                env=environment(),
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            processes.append(process)
        told = [process.communicate()[0] for process in processes]
    if not all(told):
        raise BenchmarkError("one of the processes has failed")
    rows = [json.loads(each) for each in told]
    silent = [row[0] for row in rows]
    return sum(silent[count // 2 :]), sum(silent[: count // 2]), sum(row[1] for row in rows)


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
        opener, listener, anew = _deaf(
            count, 12, open_timeout_ms=open_timeout_ms, watch=watch, seconds=seconds
        )
        rows.append([what, str(opener), str(listener), str((count // 2) ** 2), str(anew)])
    result.figures.append(Figure("deaf directions as robots have it", opener + listener, "", 0))
    share = _look_cpu_s() / (PERIOD_NS / NS_PER_S)
    result.figures.append(Figure(f"CPU of looking at {LINKS} links", 100.0 * share, "%", 0.2))
    result.details += table(["Zenoh's limit", "deaf: openers", "listeners", "of each", "opened anew"], rows)
    return result


if __name__ == "__main__":
    main()
