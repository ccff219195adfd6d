"""How many hostile connections a second a robot's port stands, without and with what may stand before it.

A robot listens, strangers without a certificate flood its port from many addresses, and another robot links
up again and again: the port stands a rate if each link is there within `REJOIN_S`. Each arm runs in a network
namespace of its own, where this machine lets us make one; nftables needs that. ``python -m
tests.benchmarks.admission ARM`` is one arm.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

import tomli_w

from agent.admission.tls_records import APPLICATION_DATA, HANDSHAKE, PROVEN_RECORDS
from agent.fleet.loading import to_dict
from agent.messages import key_expressions
from agent.security.identity import of_robot
from agent.transport.bus import Bus
from deploy.hosts.artifacts.nftables import ruleset
from tests.benchmarks.figures import Figure, Options, Result, number, spread, table
from tests.benchmarks.processes import BenchmarkError, cpu_s, environment
from tests.process.flooding import flooding
from tests.process.guarded import guarded_fleet
from tests.trusted import FLEET, authority, credentials, security

INSIDE: Final = "127.0.0.1"
OUTSIDE: Final = "127.0.0.2"
PORT: Final = 22_400
SOURCES: Final = 250
RATES: Final = (10, 20, 50, 200, 500, 1000, 2000)
REJOIN_S: Final = 3.0
PATIENCE_S: Final = 6.0
SETTLE_S: Final = 3.0
"""The flood goes on for so long before a link is tried."""
ARMS: Final = ("nothing", "proxy", "nftables")
KIND: Final = "broken"
MESSAGES: Final = 2_000
PACED: Final = 200
PERIOD_S: Final = 0.01
FIRST_RATE: Final = 200
FIRST_PATIENCE_S: Final = 150.0
FIRST: Final = "proxy, first time"


@contextmanager
def _process(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A module of ours with these arguments, once it has said its first line."""
    with subprocess.Popen(
        [sys.executable, "-m", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment(),
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        try:
            process.stdout.readline()
            rest = threading.Thread(target=process.stdout.read, daemon=True)
            rest.start()
            yield process
        finally:
            process.kill()
            rest.join()


class _Arm:
    """A robot behind what an arm has it stand behind."""

    def __init__(self, name: str, folder: Path, opened: ExitStack) -> None:
        self.name, self.folder = name, folder
        now_s = time.time()
        with authority(folder / "authority", now_s) as by:
            for robot in (1, 2):
                credentials(by, folder / str(robot), of_robot(FLEET, robot), (OUTSIDE,), now_s)
        self.proxy: subprocess.Popen[bytes] | None = None
        proxy = name.startswith("proxy")
        fleet = guarded_fleet()
        network = replace(
            fleet.network, address=OUTSIDE, base_port=PORT, routers=(), admission="proxy" if proxy else "off"
        )
        self.fleet = replace(fleet, network=network)
        listens = [*self.fleet.agent_listens(1)]
        options = {"folder": str(folder / "1"), "identity": of_robot(FLEET, 1).common_name}
        options |= {"listen": listens, "connect": [], "routers": []}  # type: ignore[dict-item]
        opened.enter_context(_process("tests.process.guarded", json.dumps(options)))
        if proxy:
            file = folder / "fleet.toml"
            file.write_text(tomli_w.dumps(to_dict(self.fleet)))
            words = ["agent.admission", "--fleet", str(file), "--robot", "1"]
            self.proxy = opened.enter_context(_process(*words))
        if name == "nftables":
            subprocess.run(["nft", "-f", "-"], input=ruleset(self.fleet, [INSIDE]), text=True, check=True)

    def rejoins_s(self, patience_s: float = PATIENCE_S) -> float:
        """How long a robot takes to have a link again, s; infinite if it has none within `patience_s`."""
        begun_s = time.monotonic()
        endpoint = self.fleet.agent_endpoint(1)
        robot_2 = security(self.folder / "2", of_robot(FLEET, 2))
        with Bus(listen=[], connect=[endpoint], security=robot_2, link_timeout_s=0.4) as bus:
            bus.subscribe(key_expressions.hand(FLEET, 1))
            while (took_s := time.monotonic() - begun_s) < patience_s:
                if any(True for _ in bus.drain()):
                    return took_s
                time.sleep(0.01)
        return float("inf")


def _peak_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:"))


class _Stood(NamedTuple):
    """What a flood did: how long each of several links took, s, how many connections a second there were, and
    the proxy's CPU (% of a core) and most memory (MB) so far, 0 without one."""

    took: list[float]
    reached: float
    cpu_percent: float
    peak_mb: float


def _stands(name: str, rate: int, tries: int) -> _Stood:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        arm = _Arm(name, Path(folder), opened)
        if name != FIRST:
            arm.rejoins_s()  # who was there before
        with flooding([(OUTSIDE, PORT)], rate, KIND, sources=SOURCES) as strangers:
            begun_s = time.monotonic()
            cpu_before_s = cpu_s(arm.proxy.pid) if arm.proxy else 0.0
            time.sleep(SETTLE_S)
            patience_s = FIRST_PATIENCE_S if name == FIRST else PATIENCE_S
            took = [arm.rejoins_s(patience_s) for _ in range(tries)]
            lasted_s = time.monotonic() - begun_s
            reached = strangers.end() / lasted_s
            if arm.proxy is None:
                return _Stood(took, reached, 0.0, 0.0)
            used = 100.0 * (cpu_s(arm.proxy.pid) - cpu_before_s) / lasted_s
            return _Stood(took, reached, used, _peak_mb(arm.proxy.pid))


def _cost() -> tuple[float, float]:
    """What the proxy adds to a message one way, and its CPU for one at 100 Hz, us: of an echo."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        arm = _Arm("proxy", Path(folder), opened)
        arm.rejoins_s()  # so that we are known
        assert arm.proxy is not None
        server = opened.enter_context(socket.create_server((INSIDE, PORT + 1)))  # where the plant would be
        record = bytes((APPLICATION_DATA, 3, 3, 0, 3)) + b"abc"
        hello = bytes((HANDSHAKE, 3, 1, 0, 40, 1)) + bytes(39)

        def echo() -> None:
            while True:
                try:
                    client, _ = server.accept()
                except OSError:
                    return  # it is over
                with client:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    client.recv(4096)
                    client.sendall(record * PROVEN_RECORDS)
                    while data := client.recv(4096):
                        client.sendall(data)

        threading.Thread(target=echo, daemon=True).start()
        trips: dict[str, list[float]] = {INSIDE: [], OUTSIDE: []}
        for _ in range(5):
            for host in (INSIDE, OUTSIDE):
                with socket.create_connection((host, PORT + 1)) as client:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    client.sendall(hello)
                    client.recv(4096)
                    for _ in range(MESSAGES):
                        begun = time.perf_counter_ns()
                        client.sendall(bytes(150))
                        client.recv(4096)
                        trips[host].append((time.perf_counter_ns() - begun) / 1e3)
                    if host == INSIDE:
                        continue
                    before_s = cpu_s(arm.proxy.pid)
                    for _ in range(PACED):
                        client.sendall(bytes(150))
                        client.recv(4096)
                        time.sleep(PERIOD_S)
                    cpu_us = (cpu_s(arm.proxy.pid) - before_s) * 1e6 / (2 * PACED)
        return (median(trips[OUTSIDE]) - median(trips[INSIDE])) / 2.0, cpu_us


def _run_arm(name: str, quick: bool) -> dict[str, Any]:
    if name == "cost":
        return dict(zip(("added_us", "cpu_us"), _cost(), strict=True))
    if name == FIRST:
        return {"took": [_stands(name, FIRST_RATE, 1).took[0] for _ in range(1 if quick else 3)]}
    rows, most = [], 0.0
    for rate in RATES[:: 2 if quick else 1]:
        stood = _stands(name, rate, 2 if quick else 5)
        took = stood.took
        rows.append([rate, stood.reached, median(took), max(took), stood.cpu_percent, stood.peak_mb])
        if max(took) > REJOIN_S:
            break
        most = stood.reached
    return {"most": most, "rows": rows}


def _in_namespace(words: Sequence[str]) -> list[str]:
    """A command in a network namespace of its own, where there may be one; else as it is."""
    if os.geteuid() == 0 and shutil.which("unshare") and shutil.which("ip"):
        return ["unshare", "--net", "sh", "-c", 'ip link set lo up && exec "$@"', "sh", *words]
    return [*words]


def run(options: Options) -> Result:
    result, rows = Result(), []
    for name in (*ARMS, FIRST, "cost"):
        words = [
            sys.executable,
            "-m",
            "tests.benchmarks.admission",
            name,
            *(["quick"] if options.quick else []),
        ]
        command = _in_namespace(words)
        if name == "nftables" and (command == words or not shutil.which("nft")):
            result.details.append("nftables: not measured: needs root, unshare and nft")
            continue
        done = subprocess.run(command, env=environment(), stdout=subprocess.PIPE, check=False)
        if done.returncode:
            raise BenchmarkError(f"the arm {name} ended with exit status {done.returncode}")
        found = json.loads(done.stdout)
        if name == "cost":
            result.figures.append(Figure("the proxy adds to a message, one way", found["added_us"], "us"))
            result.figures.append(Figure("CPU of the proxy for a message", found["cpu_us"], "us"))
            continue
        if name == FIRST:
            what = f"{FIRST_RATE} connections a second of {SOURCES} strangers, first link through the proxy"
            result.figures.append(Figure(what, max(found["took"]), "s", note=spread(found["took"])))
            continue
        limit = None if name == "nothing" else 500.0
        result.figures.append(
            Figure(f"hostile connections a second that it stands, {name}", found["most"], "1/s", limit, False)
        )
        rows += [[f"{name}, {row[0]}/s", *map(number, row[1:])] for row in found["rows"]]
    heading = ("arm", "reached 1/s", "link after s, median", "slowest", "proxy's CPU %", "most memory MB")
    result.details += table(heading, rows)
    return result


if __name__ == "__main__":
    print(json.dumps(_run_arm(sys.argv[1], len(sys.argv) > 2)))
