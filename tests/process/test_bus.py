"""The bus in its bad moments: what cannot be opened, any order of start, and garbage on every key."""

from __future__ import annotations

import contextlib
import json
import random
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from math import inf, nan
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import pytest
import tomli_w
import zenoh

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import VERSION, decode, encode
from handfast.agent.messages.types import (
    Ask,
    Beacon,
    Checks,
    HandState,
    Heartbeat,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.messages.validation import Malformed
from handfast.agent.transport.bus import Bus
from tests.process.fleet_harness import Robots, make_fleet, placed, robots
from tests.process.harness import (
    BUSY,
    BUSY_SETTINGS,
    Command,
    environment,
    measured,
    no_trouble_in_logs,
)
from tests.process.same_way import assert_same_way
from tests.wire import sealed

AGREE_M = 0.02
SECONDS = 8.0


# ---------------------------------------------------------------------- what cannot be opened


def agent_fails(folder: Path, fleet: Fleet, robot: int, role: str = "agent", status: int = 1) -> str:
    """Starts one process that must end with that exit status; what it says."""
    file = folder / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(fleet)))
    done = subprocess.run(
        [sys.executable, "-P", "-m", f"handfast.{role}", "--fleet", str(file), "--robot", str(robot)],
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=10.0,
    )
    assert (done.returncode, done.stdout) == (status, ""), done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert ".rs" not in done.stderr, "the library's source paths say nothing to a user"
    return done.stderr


@pytest.mark.parametrize("role", key_expressions.ROLES)
def test_port_in_use(tmp_path: Path, role: str) -> None:
    with placed(make_fleet()) as fleet, socket.socket() as taken:
        endpoint = fleet.agent_endpoint(1) if role == "agent" else fleet.plant_endpoint(1)
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))
        taken.listen()
        says = agent_fails(tmp_path, fleet, 1, role)
    assert says.startswith(f"robot 1 {role}: cannot listen on {endpoint}: the port is in use")
    assert "base_port" in says


def test_same_robot_twice(tmp_path: Path) -> None:
    """The second agent of a robot is refused; the first does not notice."""
    with robots(tmp_path / "r") as all_robots:
        says = agent_fails(tmp_path, all_robots.fleet, 1)
        assert f"cannot listen on {all_robots.fleet.agent_endpoint(1)}: the port is in use" in says
        all_robots.drive()
        assert not all_robots.died()


@pytest.mark.long
def test_address_of_another_machine(tmp_path: Path) -> None:
    with placed(make_fleet(), address="192.0.2.1") as fleet:  # TEST-NET-1: nobody has it
        says = agent_fails(tmp_path, fleet, 1)
    assert says.startswith(
        f"robot 1 agent: cannot listen on {fleet.agent_endpoint(1)}: this machine does not"
    )


# ---------------------------------------------------------------------- order of start

ORDERS = (
    ((2, "plant"), (2, "agent"), (1, "plant"), (1, "agent")),  # each before the one that it connects to
    ((1, "agent"), (2, "agent"), (1, "plant"), (2, "plant")),
)


@pytest.mark.parametrize("order", ORDERS, ids=["dialling_first", "listening_first"])
def test_any_order_of_start(tmp_path: Path, order: Sequence[tuple[int, str]]) -> None:
    with placed(make_fleet()) as fleet, Robots(fleet, tmp_path / "r") as all_robots:
        for robot, role in order:
            all_robots.start(robot, role)
            all_robots.wait_until_alive(robot, role)
            assert set(all_robots.states().values()) <= {"waiting", "ready"}
        all_robots.wait_until_all("ready")
        all_robots.drive()
        for robot, role in order:
            assert all_robots.end(robot, role) == 0
        no_trouble_in_logs(all_robots.folder)


# ---------------------------------------------------------------------- garbage


class Hostile:
    """A stranger on the bus that has valid messages to spoil and knows every key.

    It listens, and sends what it heard at least `OLD_S` ago, broken in every way; never a valid
    message that is new: forging those is a matter of authentication.

    Args:
        fleet: placed.
        seed: of everything that it draws.
        pause_s: between two rounds; each round sends one message of each kind on each key.
    """

    OLD_S = 0.5

    def __init__(self, fleet: Fleet, seed: int, pause_s: float) -> None:
        self.sent = 0
        self._random = random.Random(seed)
        self._pause_s = pause_s
        name, ids = fleet.fleet.name, [*fleet.ids]
        of_robot = (
            key_expressions.hand,
            key_expressions.beacon,
            key_expressions.relayed,
            key_expressions.status,
            key_expressions.plant_state,
            key_expressions.plant_truth,
            key_expressions.wrench,
            key_expressions.checks,
        )
        self._keys = [
            *(of(name, robot) for of in of_robot for robot in ids),
            key_expressions.mission(name),
            key_expressions.stop(name),
            key_expressions.resume(name),
            key_expressions.heartbeat(name),
            key_expressions.ask(name),
            f"{name}/faults",
            key_expressions.hand(name, 9999),
            key_expressions.status(name, 9999),
            f"{name}/{secrets.token_hex(4)}/made/up",
        ]
        self._wild = [
            *(
                of(name, "*")
                for of in (
                    key_expressions.hand,
                    key_expressions.beacon,
                    key_expressions.wrench,
                    key_expressions.plant_state,
                )
            ),
            f"{name}/**",
        ]
        self._ids = ids
        self._endpoints = [
            endpoint
            for robot in ids
            for endpoint in (fleet.agent_endpoint(robot), fleet.plant_endpoint(robot))
        ]
        self._routers = fleet.router_endpoints
        self._own: set[tuple[str, bytes]] = set()
        """What it has put: a router brings that to its ear, too."""
        self._heard: list[tuple[float, str, bytes]] = []
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hostile")

    def __enter__(self) -> Hostile:
        # Its own configuration would do; the product's keeps it to the endpoints that it is told.
        ends: dict[str, Any] = {"listen": [], "connect": [] if self._routers else self._endpoints}
        self._bus = Bus(**ends, routers=self._routers)
        self._session: Any = self._bus._far
        # A session hears itself, and peers do not relay: a second one hears the fleet and no garbage.
        self._ear = Bus(**ends, routers=self._routers)
        self._ear.subscribe(f"{self._keys[0].partition('/')[0]}/**", 4096)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.close()
        self._ear.close()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while not self._stop.wait(self._pause_s):
                self._round()
        except BaseException as error:
            self._failure = error

    def _put(self, key: str, payload: bytes) -> None:
        if self._routers:
            self._own.add((key, payload))
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)
        self.sent += 1

    def _round(self) -> None:
        draw, now_s = self._random, time.monotonic()
        fresh = [(now_s, *each) for each in self._ear.drain() if each not in self._own]
        for _, key, payload in fresh[-20:]:
            self._put(key, payload)  # at once, and word for word
        self._heard += fresh
        del self._heard[:-2000]
        old = [(key, payload) for at_s, key, payload in self._heard if at_s < now_s - self.OLD_S]
        for key in self._keys:
            self._put(key, draw.choice(self._nonsense()))
            if old:
                self._put(key, draw.choice(old)[1])  # another key's, another robot's, or its own again
                self._put(key, self._spoilt(draw.choice(old)[1]))
        for key in self._wild:
            self._put(key, draw.randbytes(40))
            if old:
                self._put(key, draw.choice(old)[1])
        for key, payload in draw.sample(old, min(4, len(old))):
            self._put(key, payload)  # word for word, too late
        key = draw.choice(self._keys)
        self._own.add((key, b""))
        self._session.delete(key)

    def _spoilt(self, payload: bytes) -> bytes:
        """Cut, lengthened, or with one bit turned; if that gives a newer valid message, cut."""
        draw = self._random
        cut = payload[: draw.randrange(len(payload))]
        kind = draw.randrange(3)
        if kind == 0:
            return cut
        if kind == 1:
            return payload + draw.randbytes(draw.randrange(1, 9))
        at = draw.randrange(len(payload))
        turned = payload[:at] + bytes([payload[at] ^ 1 << draw.randrange(8)]) + payload[at + 1 :]
        try:
            was, became = decode(payload), decode(turned)
        except Malformed:
            return turned
        if type(was) is type(became) and became.time_ns <= was.time_ns and became[0] == was[0]:
            return turned
        return cut

    def _nonsense(self) -> list[bytes]:
        draw = self._random
        robot, now_ns = draw.choice(self._ids), time.time_ns()
        stranger = draw.choice((0, -1, 77, 9999, 2**40))
        far_ns = now_ns + 3600 * 10**9
        bad = draw.choice((nan, inf, -inf, 1e308))
        numbers = [bad, bad, *[0.0] * 9]
        return [
            b"",
            draw.randbytes(draw.randrange(1, 200)),
            draw.randbytes(20_000),
            bytes(70_000),  # dropped at the link
            sealed(draw.randbytes(draw.randrange(1, 200))),
            sealed(b"\xdd\xff\xff\xff\xff"),  # an array of 2**32 - 1 entries, it says
            sealed(b"\x91" * 4000),  # nested as deep as it goes
            sealed(msgpack.packb([VERSION, 0])),
            sealed(msgpack.packb([VERSION + 1, 0, robot, 1, now_ns])),
            msgpack.packb([1, 0, robot, 1, now_ns]),  # of version 1, which had no checksum
            sealed(msgpack.packb([VERSION, 99, robot, 1, now_ns])),
            sealed(msgpack.packb({"robot": robot})),
            sealed(msgpack.packb([VERSION, 0, str(robot), 1, now_ns, True, *numbers, [], []])),
            encode(HandState(robot, 1, now_ns, True, 0, nan, *[0.0] * 10, (), ())),
            encode(HandState(robot, 1, now_ns, True, 0, *[0.0] * 11, ((1, inf),), ())),
            encode(HandState(stranger, 1, now_ns, True, 0, *[0.0] * 11, (), ())),
            encode(HandState(robot, 1, far_ns, True, 0, *[0.0] * 11, (), ())),
            encode(HandState(robot, 1, -now_ns, True, 0, *[0.0] * 11, (), ())),
            encode(Beacon(robot, 1, now_ns, True, inf, *[0.0] * 4, 0, 0, -1, -1)),
            encode(Beacon(stranger, 1, now_ns, True, *[0.0] * 5, 2**61, 0, 2**61, 2**61)),
            encode(Beacon(robot, 1, far_ns, True, *[0.0] * 5, 0, 0, -1, -1)),
            encode(PlantState(robot, 1, now_ns, *[nan] * 7, True, True, True, "")),
            encode(PlantState(stranger, 1, now_ns, *[0.0] * 7, True, False, True, "x" * 199)),
            encode(PlantState(robot, 1, 0, *[0.0] * 7, False, False, True, "from 1970")),
            encode(PlantState(robot, 1, far_ns, *[0.0] * 7, True, True, True, "")),
            encode(Wrench(robot, 1, now_ns, inf, 0.0, False)),
            encode(Wrench(stranger, 1, now_ns, 99.0, 0.0, False)),
            encode(Wrench(robot, 1, far_ns, 99.0, 9.0, False)),
            encode(Wrench(robot, 1, 1, 99.0, 9.0, False)),
            encode(Mission(2**61, now_ns, now_ns, 10**9, "0123456789abcdef")),  # of a time to come
            encode(Mission(now_ns // 1_000, now_ns, now_ns, 10**9, "0123456789abcdef")),  # for another file
            encode(Mission(1, now_ns, now_ns, 0, "0123456789abcdef")),
            encode(Stop(-1, now_ns, "")),
            encode(Resume(-1, now_ns, ())),
            encode(Resume(2**61, now_ns, (2**40,))),
            encode(Heartbeat(-1, "")),
            encode(Ask(2**63, "")),
            encode(Checks(robot, 1, now_ns, (("gps", "bad", "", ""),))),
            encode(Status(stranger, 1, now_ns, "fault", "", "", 0, 0, (), (), (), ())),
        ]


def throw_at_ports(fleet: Fleet, seed: int) -> None:
    """Bytes that are not Zenoh's at every port, as a port scanner sends them."""
    draw = random.Random(seed)
    own = [each(robot) for robot in fleet.ids for each in (fleet.agent_endpoint, fleet.plant_endpoint)]
    for endpoint in (*own, *fleet.router_endpoints):
        port = int(endpoint.rpartition(":")[2])
        for payload in (
            b"",
            b"GET / HTTP/1.0\r\n\r\n",
            draw.randbytes(2000),
            b"\xff\xff" + bytes(70_000),
        ):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0) as link:
                link.sendall(payload)


@pytest.mark.alone
def test_garbage_on_every_key_changes_nothing(tmp_path: Path) -> None:
    seed = 20_080_704
    # On a busy machine the garbage shall be judged, not the scheduler.
    arguments = ("pair", "--duration", f"{SECONDS:g}", *BUSY, "--no-report", "--out", "out")
    with Command(tmp_path / "simulated", "simulate", *arguments) as command:
        assert command.wait() == 0, command.told()
    with Command(tmp_path, "run", *arguments, "--set", "network.base_port=21120") as command:
        command.wait_for_line("starting 2 agents")
        fleet = load_fleet(tmp_path / "out" / "fleet.toml")
        with Hostile(fleet, seed, pause_s=0.02) as hostile:
            command.wait_for_line("all 4 processes alive")
            assert len(command.children()) == 4
            command.wait_for_line(r"(?m)^ +2\.\d s ")
            throw_at_ports(fleet, seed)
            command.wait_for_line(rf"(?m)^ +{SECONDS - 2:.0f}\.\d s ")
            assert len(command.children()) == 4, command.told()
            assert hostile.sent > 3000
        assert command.wait() == 0, command.told()
    folder = tmp_path / "out"
    no_trouble_in_logs(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    reasons = metrics["messages_rejected_by_reason"]
    for reason in (
        "checksum", "duplicate", "future", "malformed", "not_finite", "out_of_order", "oversized", "range",
        "type", "version", "wrong_key", "digest",
    ):  # fmt: skip
        assert reasons.get(reason, 0) > 0, f"no message was counted as {reason}: {reasons}"
    assert metrics["messages"]["rejected"] == sum(reasons.values())
    assert all("ended the drive in state" not in reason for reason in metrics["verdict"]["reasons"]), metrics
    assert_same_way(folder, tmp_path / "simulated" / "out", SECONDS, AGREE_M)


@pytest.mark.long
def test_flood_harms_nobody_for_longer_than_it_lasts(tmp_path: Path) -> None:
    """Flat out on every key, far more than the inboxes hold: robots may brake, and drive on afterwards."""
    with robots(
        tmp_path / "r", "pair", 'trajectory.kind="line"', "trajectory.velocity_mps=[0.3,0.2]"
    ) as all_robots:
        epoch_ns = all_robots.drive()
        before = {robot: all_robots.counters(robot)["rejected"] for robot in all_robots.fleet.ids}
        with Hostile(all_robots.fleet, 7, pause_s=0.0) as hostile:
            until = time.monotonic() + 1.5
            all_robots.wait(lambda: hostile.sent > 60_000 and time.monotonic() > until, "a flood")
        ended_ns = time.time_ns()
        for robot in all_robots.fleet.ids:
            took, _ = all_robots.first(
                ended_ns, Status, robot, lambda m: m.state == "running", f"robot {robot} drives on"
            )
            measured("back after the flood, s", took)
            assert all_robots.counters(robot)["rejected"] > before[robot] + 1000
        all_robots.first(ended_ns, PlantState, 1, lambda m: m.driving and m.speed > 0.1, "robot 1 moves")
        assert not all_robots.died(), all_robots.told()
        no_trouble_in_logs(all_robots.folder)
        mission = all_robots.mission
        assert mission is not None
        assert mission.epoch_ns == epoch_ns
        for robot in all_robots.fleet.ids:
            assert all_robots.end(robot, "agent") == 0
            assert all_robots.end(robot, "plant") == 0


def test_old_messages_do_not_move_a_robot_that_starts_again(tmp_path: Path) -> None:
    """A fresh agent and plant have no memory to tell old from new by; the age must do."""
    with robots(tmp_path / "r", "pair", *BUSY_SETTINGS) as all_robots:
        all_robots.drive()
        name, bus = all_robots.name, all_robots.bus
        old = {key: encode(all_robots.latest[key]) for key in all_robots.latest if "/robot/1/" in key}
        assert not all_robots.wrench(1).brake  # type: ignore[union-attr]
        for role in key_expressions.ROLES:
            all_robots.signal(1, role, signal.SIGKILL)
            all_robots.processes[1, role].wait()
        all_robots.wait(lambda: all_robots.states()[2] == "holding", "robot 2 holds")
        # What is younger than the watchdog's limit may be obeyed, and a plant starts in a third of a second.
        limit_ns = 3 * all_robots.fleet.control.wrench_timeout_s * NS_PER_S
        newest_ns = max(decode(payload).time_ns for payload in old.values())
        all_robots.wait(lambda: time.time_ns() - newest_ns > limit_ns, "the messages are old")
        for key in (
            key_expressions.hand(name, 1),
            key_expressions.wrench(name, 1),
            key_expressions.plant_state(name, 1),
        ):
            bus.declare(key)
        all_robots.start(1, "plant")
        from_ns = time.time_ns()

        def replay() -> bool:
            for key in (
                key_expressions.hand(name, 1),
                key_expressions.wrench(name, 1),
                key_expressions.plant_state(name, 1),
            ):
                bus.publish(key, old[key])
            return sum(1 for _ in all_robots.since(from_ns, PlantState, 1)) >= 25

        all_robots.wait(replay, "25 states of the new plant")
        assert not any(m.driving for _, m in all_robots.since(from_ns, PlantState, 1))
        assert all_robots.states()[2] == "holding"
        all_robots.start(1, "agent")
        all_robots.wait_until_all("running")
        assert not all_robots.died()
