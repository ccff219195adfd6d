"""What messages take on the links between robots, and whether `check` says so: bytes, counted by the kernel.

Real agents and plants on loopback, in a mesh, with routers and with secured links. Of each TCP socket the
kernel tells how many bytes and packets it has sent (tcp_info, `ss`); a packet has 52 bytes of headers.
Between the processes of one robot nothing goes over its radio. What `deploy.check.load.radio_load` predicts
is compared for every robot: where it is off, the constants of `agent.links.wire_size` or the sizes of
messages are stale.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from agent.fleet.model import Fleet
from agent.formation.geometry import resolve
from agent.links.wire_size import (
    ACKNOWLEDGED,
    HEADERS_BYTES,
    KEEP_ALIVE_BYTES,
    KEEP_ALIVE_HZ,
    TLS_BYTES,
    ZENOH_BYTES,
)
from agent.messages import key_expressions
from agent.security.access_control import Security
from agent.transport.bus import Bus
from deploy.check.load.radio_load import RadioLoad, radio_loads
from tests.benchmarks.figures import Figure, Options, Result, number, table
from tests.benchmarks.processes import BenchmarkError, NotHereError, end, environment, handfast
from tests.benchmarks.startup import command_of
from tests.process.fleet_harness import Robots, make_fleet, placed
from tests.process.secured_fleet import Keys, secured_robots, three

SIZES: Final = (50, 100, 150, 300, 600, 1200)
"""Payloads of the pair of sessions, bytes."""
PERIOD_S: Final = 0.05
IDLE_S: Final = 5.0
OPERATOR: Final = 0
"""In the place of a robot: an operator, or a router."""
RATE_HZ: Final = 20.0
START_S: Final = 60.0
SETTLE_S: Final = 12.0
"""Then all are at their places, nearly."""
_NUMBERS: Final = re.compile(r"\b(bytes_sent|segs_out|data_segs_out):(\d+)")
_PID: Final = re.compile(r"pid=(\d+)")


class Socket(NamedTuple):
    """One end of a TCP connection: its process, and what it has sent since it was opened."""

    pid: int
    stream_bytes: int
    packets: int
    with_data: int

    @property
    def bytes(self) -> int:
        return self.stream_bytes + HEADERS_BYTES * self.packets

    def since(self, before: Socket) -> Socket:
        return Socket(
            self.pid,
            self.stream_bytes - before.stream_bytes,
            self.packets - before.packets,
            self.with_data - before.with_data,
        )


Ends = tuple[str, str]
"""Own and other address of a socket."""


def sockets() -> dict[Ends, Socket]:
    """All TCP sockets of this machine that are connected."""
    try:
        done = subprocess.run(["ss", "-tinpH", "state", "established"], capture_output=True, text=True)
    except FileNotFoundError:
        raise NotHereError("there is no ss (iproute2) here") from None
    found: dict[Ends, Socket] = {}
    own = other = ""
    pid = 0
    for line in done.stdout.splitlines():
        if not line[:1].isspace():
            own, other = line.split()[2:4]
            named = _PID.search(line)
            pid = int(named[1]) if named is not None else 0
            continue
        counts = {name: int(value) for name, value in _NUMBERS.findall(line)}
        found[own, other] = Socket(
            pid, counts.get("bytes_sent", 0), counts.get("segs_out", 0), counts.get("data_segs_out", 0)
        )
    return found


def sent_within(window_s: float, meanwhile: Callable[[], None] = lambda: None) -> dict[Ends, Socket]:
    """What every socket that was there all the time sent in a window that is at least so long."""
    before, until = sockets(), time.monotonic() + window_s
    while time.monotonic() < until:
        meanwhile()
        time.sleep(0.02)
    return {ends: each.since(before[ends]) for ends, each in sockets().items() if ends in before}


# --- what is around one message -------------------------------------------------------------------


class Around(NamedTuple):
    """What is around messages of a pair of sessions, one message every `PERIOD_S`.

    Attributes:
        stream: bytes of the stream around each payload, by `SIZES`.
        packets, acknowledged: that carry it, that only acknowledge it, for each message.
        alive_hz, alive_bytes: signs of life on an idle link, a second, and bytes of the stream for each.
    """

    stream: list[float]
    packets: list[float]
    acknowledged: list[float]
    alive_hz: float
    alive_bytes: float


def around(port: int, key: str, count: int, security: Callable[[str], Security] | None) -> Around:
    """Measures a pair of sessions of this process."""
    scheme = "tls" if security is not None else "tcp"
    endpoint = f"{scheme}/127.0.0.1:{port}"
    one, other = (security(name) if security is not None else None for name in ("listens", "dials"))
    with (
        Bus(listen=[endpoint], connect=[], security=one) as source,
        Bus(listen=[], connect=[endpoint], security=other) as sink,
    ):
        source.declare(key)
        sink.subscribe(key)
        time.sleep(1.0)

        def both(sent: Mapping[Ends, Socket]) -> tuple[Socket, Socket]:
            there = next(each for (own, _), each in sent.items() if own.endswith(f":{port}"))
            back = next(each for (_, far), each in sent.items() if far.endswith(f":{port}"))
            return there, back

        idle, _ = both(sent_within(IDLE_S))
        found = Around([], [], [], idle.with_data / IDLE_S, idle.stream_bytes / max(1, idle.with_data))
        for size in SIZES:
            before, came = sockets(), 0
            for _ in range(count):
                source.publish(key, bytes(size))
                time.sleep(PERIOD_S)
                came += sum(1 for _ in sink.drain())
            there, back = both({k: each.since(before[k]) for k, each in sockets().items() if k in before})
            assert came == count, f"{came} of {count} messages came"
            found.stream.append(there.stream_bytes / count - size)
            found.packets.append(there.with_data / count)
            found.acknowledged.append((back.packets - back.with_data) / count)
        return found


# --- whole fleets ---------------------------------------------------------------------------------


class Measured(NamedTuple):
    """What robots sent and received, bit/s, by robot, and how many of the packets between robots only
    acknowledged others, by those that carried something."""

    up: Mapping[int, float]
    down: Mapping[int, float]
    acknowledged: float


def among(
    sent: Mapping[Ends, Socket], robot_of: Mapping[int, int], window_s: float, operator: bool
) -> Measured:
    """Of the robots whose processes these are; what goes to and from `OPERATOR` only where it counts."""
    up: dict[int, float] = defaultdict(float)
    down: dict[int, float] = defaultdict(float)
    carried = bare = 0
    for (own, far), each in sent.items():
        other = sent.get((far, own))
        if other is None or each.pid not in robot_of or other.pid not in robot_of:
            continue
        source, destination = robot_of[each.pid], robot_of[other.pid]
        if source == destination or (OPERATOR in (source, destination) and not operator):
            continue
        up[source] += 8.0 * each.bytes / window_s
        down[destination] += 8.0 * each.bytes / window_s
        carried, bare = carried + each.with_data, bare + each.packets - each.with_data
    return Measured(up, down, bare / max(1, carried))


@contextmanager
def mesh(folder: Path, secured: bool) -> Iterator[tuple[Fleet, Robots]]:
    """A delta of real processes, or three secured ones, driving, and an operator that listens to all."""
    if secured:
        with secured_robots(three(f"fleet.rate_hz={RATE_HZ}"), folder) as robots:
            robots.drive()
            yield robots.fleet, robots
        return
    with placed(make_fleet("delta", f"fleet.rate_hz={RATE_HZ}")) as fleet, Robots(fleet, folder) as robots:
        robots.start_all()
        robots.drive()
        yield fleet, robots


def of_mesh(folder: Path, secured: bool, window_s: float) -> list[tuple[str, list[RadioLoad], Measured]]:
    """Predicted and measured: among the robots, and with the operator."""
    with mesh(folder, secured) as (fleet, robots):
        pids = {process.pid: robot for (robot, _), process in robots.processes.items()}
        sent_within(SETTLE_S, robots.collect)
        begun = time.monotonic()
        sent = sent_within(window_s, robots.collect)
        took_s = time.monotonic() - begun
    name = f"mesh, {'secured' if secured else 'plain'}"
    geometry = resolve(fleet)
    return [
        (name, radio_loads(fleet, geometry, operator=False), among(sent, pids, took_s, operator=False)),
        (
            f"{name}, an operator listens to all",
            radio_loads(fleet, geometry, operator=True),
            among(sent, {**pids, os.getpid(): OPERATOR}, took_s, operator=True),
        ),
    ]


def of_routers(folder: Path, window_s: float) -> tuple[str, list[RadioLoad], Measured]:
    """Predicted and measured behind a router, which passes everything on to the operator too."""
    fleet = make_fleet("delta", f"fleet.rate_hz={RATE_HZ}", 'network.topology="routed"')
    sets = ("--set", f"fleet.rate_hz={RATE_HZ}", "--set", 'network.topology="routed"')
    command = handfast(
        "run", "delta", *sets, "--duration", "600", "--no-report", "--out", str(folder / "run")
    )
    with open(folder / "told", "w+") as told:
        process = subprocess.Popen(
            command, stdout=told, stderr=told, env=environment(), start_new_session=True
        )
        try:
            until = time.monotonic() + START_S
            while b" s  worst" not in (folder / "told").read_bytes():
                if process.poll() is not None or time.monotonic() > until:
                    raise BenchmarkError(f"it does not drive: {(folder / 'told').read_text()[-500:]}")
                time.sleep(0.1)
            pids = {}
            for pid in {each.pid for each in sockets().values()}:
                words = command_of(pid).decode(errors="replace").split("\0")
                if str(folder / "run") in " ".join(words):
                    pids[pid] = int(words[words.index("--robot") + 1]) if "--robot" in words else OPERATOR
            time.sleep(SETTLE_S)
            begun = time.monotonic()
            sent = sent_within(window_s)
            took_s = time.monotonic() - begun
        finally:
            end(process, 20.0)
    found = among(sent, pids, took_s, operator=True)
    loads = radio_loads(fleet, resolve(fleet), operator=True)
    return "routed, an operator listens to all", loads, found


def run(options: Options) -> Result:
    window_s = 10.0 if options.quick else 30.0
    count = 60 if options.quick else 200
    result = Result()
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        folder = Path(name)
        _around(result, folder, count)
        arms = []
        for secured in (False, True):
            (folder / f"mesh-{secured}").mkdir()
            arms += of_mesh(folder / f"mesh-{secured}", secured, window_s)
        arms.append(of_routers(folder, window_s))
    rows = []
    for arm, loads, found in arms:
        ratios = [
            measured / predicted
            for load in loads
            for predicted, measured in ((load.up, found.up[load.robot]), (load.down, found.down[load.robot]))
        ]
        note = f"{min(ratios):.3f} to {max(ratios):.3f}; acknowledged alone {found.acknowledged:.2f}"
        result.figures.append(Figure(f"{arm}: measured / predicted", median(ratios), note=note))
        worst = max(loads, key=lambda load: load.most)
        pairs = ((worst.up, found.up[worst.robot]), (worst.down, found.down[worst.robot]))
        rows.append([arm, str(worst.robot), *(f"{value / 1e3:.1f}" for pair in pairs for value in pair)])
    heading = ["kbit/s", "robot", "up, predicted", "measured", "down, predicted", "measured"]
    result.details += ["", *table(heading, rows)]
    return result


def _around(result: Result, folder: Path, count: int) -> None:
    """What is around a message, beside the constants."""
    fleet = three()
    with placed(fleet) as here, Keys(here, folder / "keys") as keys:
        pair = {"listens": keys.security(keys.robot(1)), "dials": keys.security(keys.robot(2))}
        key = key_expressions.hand(fleet.fleet.name, 1)
        plain = around(here.network.base_port, key, count, None)
        secured = around(here.network.base_port + 1, key, count, pair.__getitem__)
    tls = median(a - b for a, b in zip(secured.stream, plain.stream, strict=True))
    result.figures += [
        Figure("Zenoh adds to a message", median(plain.stream), "bytes", note=f"taken as {ZENOH_BYTES}"),
        Figure("TLS adds", tls, "bytes", note=f"taken as {TLS_BYTES}"),
        Figure("signs of life on an idle link", plain.alive_hz, "Hz", note=f"taken as {KEEP_ALIVE_HZ:g}"),
        Figure("of so many bytes", plain.alive_bytes, note=f"taken as {KEEP_ALIVE_BYTES}"),
        Figure(
            "packets that acknowledge, for each message of a one-way link",
            median(plain.acknowledged),
            note=f"taken as {ACKNOWLEDGED}: most links carry something both ways",
        ),
    ]
    rows = [
        [str(size), *(number(value) for value in (a, b, c, d))]
        for size, a, b, c, d in zip(
            SIZES, plain.stream, secured.stream, plain.packets, secured.packets, strict=True
        )
    ]
    result.details += table(
        ["payload, bytes", "added, plain", "added, secured", "packets, plain", "packets, secured"], rows
    )
