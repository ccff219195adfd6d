"""Links of a secured fleet, over real sessions: who is not let in, who may not say what, and that it shows.

Robots 1 and 3 are processes that talk to each other all the while; whoever attacks them is in this process.
"""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest
import zenoh

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Resume, Stop
from handfast.agent.security.credentials import Files, load
from handfast.agent.security.identity import (
    Identity,
    Security,
    of_operator,
    of_robot,
    of_router,
    tls_settings,
)
from handfast.agent.security.sealed_order import Sealer
from handfast.agent.transport.bus import PAYLOAD_BYTES_MAX, Bus, Mode, settings_of
from handfast.deploy.inventory.certificate_authority import Authority
from handfast.deploy.processes.placement import Reservation
from tests.process.harness import ADDRESS, PATIENCE_S, environment, measured, no_trouble, wait_for
from tests.trusted import FLEET, authority, credentials, security

BASE_PORT = 21_600
GAP_S = 5.0
"""For so long the honest never miss each other, on a machine that is busy; a link that is cut stays so."""
ATTACK = b"attack"
SHORT_ID = "abcdef0123456789abcdef012345678"
"""Of a session, one of sixteen of which has such a one: Zenoh leaves out zeros in front."""
HUGE = 64_000_000
"""Bytes of a message that no robot has reason to send."""
Told = Callable[[dict[str, Any]], bool]
AGO_S = 400 * 86_400.0


class Guarded:
    """One process of `tests.process.guarded`; leaving it ends it."""

    def __init__(
        self,
        folder: Path,
        identity: Identity,
        listen: list[str],
        connect: list[str],
        routers: list[str] | None = None,
    ) -> None:
        options = {"folder": str(folder), "identity": identity.common_name} | {
            "listen": listen,
            "connect": connect,
            "routers": routers or [],
        }
        self.told: list[dict[str, Any]] = []
        self.errors = folder / f"{identity.common_name}.stderr"
        with open(self.errors, "wb") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.process.guarded", json.dumps(options)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env=environment(),
                start_new_session=True,
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Guarded:
        self.wait(lambda what: "ready" in what, "it is ready")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                self.told.append(json.loads(line))

    def end(self) -> None:
        """Ends it, and sees that it went well."""
        if self.process.poll() is None:
            assert self.process.stdin is not None
            self.process.stdin.close()
            try:
                self.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._reader.join(5.0)
        no_trouble(self.errors.read_text(), "its standard error")
        assert self.process.returncode == 0

    def wait(self, matches: Told, what: str) -> dict[str, Any]:
        """The first that it tells, or has told, that matches."""
        return wait_for(
            lambda: next(filter(matches, list(self.told)), None),
            what,
            report=lambda: f"{self.told[-20:]}\n{self.errors.read_text()}",
        )

    def kill(self) -> None:
        """Ends it if it has not ended, whatever it is doing."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
            self._reader.join(5.0)
        assert self.process.stdin is not None
        self.process.stdin.close()

    def hears(self, robot: int) -> None:
        self.wait(
            lambda what: what.get("heard") == key_expressions.hand(FLEET, robot), f"it hears robot {robot}"
        )

    def refuses(self, text: str) -> str:
        """The line of its log that holds `text`."""
        return str(self.wait(lambda what: text in what.get("refused", ""), text)["refused"])

    @property
    def got(self) -> list[str]:
        """Keys of what it got that honest robots do not send."""
        return [what["got"] for what in list(self.told) if "got" in what]

    @property
    def alive(self) -> set[str]:
        """Liveliness tokens that came, whether they have gone or not."""
        return {what["alive"] for what in list(self.told) if "alive" in what}

    @property
    def gaps(self) -> dict[str, float]:
        """How long it missed each of the others, s; when it has ended."""
        return dict(next(what["gaps"] for what in self.told if "gaps" in what))


class Fleet:
    """Credentials of a fleet, and robots 1 and 3 that talk to each other over a secured link."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.port, self.now_s = folder, port, time.time()
        self.by = authority(folder / "authority", self.now_s - AGO_S)
        for robot in (1, 2, 3):
            self.make(of_robot(FLEET, robot))
        self.one = Guarded(folder / "robot-1", of_robot(FLEET, 1), [self.endpoint()], [])
        self.three = Guarded(folder / "robot-3", of_robot(FLEET, 3), [], [self.endpoint()])

    def endpoint(self, protocol: str = "tls", offset: int = 0) -> str:
        return f"{protocol}/{ADDRESS}:{self.port + offset}"

    def make(
        self, identity: Identity, by: Authority | None = None, at_s: float | None = None, folder: str = ""
    ) -> Path:
        """Credentials of `identity`; the folder that they are in."""
        made = self.folder / (folder or str(identity).replace(" ", "-"))
        credentials(by or self.by, made, identity, (ADDRESS,), at_s or self.now_s)
        return made

    def begin(self) -> None:
        for robot, other in ((self.one, 3), (self.three, 1)):
            robot.wait(lambda what: "ready" in what, "it is ready")
            robot.hears(other)

    def end(self) -> None:
        """Ends the robots, which never missed each other."""
        if self.one.process.poll() is not None:
            return  # by the test
        for robot in (self.three, self.one):
            robot.end()
        self.by.close()
        gaps = [
            self.one.gaps[key_expressions.hand(FLEET, 3)],
            self.three.gaps[key_expressions.hand(FLEET, 1)],
        ]
        assert measured("longest gap of the honest, s", max(gaps)) < GAP_S

    def kill(self) -> None:
        for robot in (self.one, self.three):
            robot.kill()


@pytest.fixture
def port() -> Iterator[int]:
    """The first of four that no other test or run has."""
    reserved = Reservation(ADDRESS, BASE_PORT, 4)
    yield reserved.base
    reserved.close()


@pytest.fixture
def fleet(tmp_path: Path, port: int) -> Iterator[Fleet]:
    """A fleet whose honest robots must not be disturbed by what the test does."""
    made = Fleet(tmp_path, port)
    try:
        made.begin()
        yield made
        made.end()
    finally:
        made.kill()


def attacks(connect: str, who: Security | None, mode: Mode = "peer", **more: Any) -> zenoh.Session:
    """A session that does not check what it hears, and does not mind what it sends."""
    settings = settings_of(mode, [], [connect], who) | {
        "access_control": {"enabled": False},
        "low_pass_filter": [],
    }
    made = zenoh.Config()
    for path, value in (settings | more).items():
        made.insert_json5(path, json.dumps(value))
    return zenoh.open(made)


def heard(session: zenoh.Session, *where: str) -> None:
    """Waits until somebody listens: what is said before is lost."""
    for key in where:
        publisher = session.declare_publisher(key)
        wait_for(lambda said=publisher: said.matching_status.matching, f"somebody listens to {key}")  # type: ignore[misc]
        publisher.undeclare()


def peak_mb(pid: int) -> float:
    """The most memory that a process ever had, 10^6 bytes."""
    found = re.search(r"^VmHWM:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found
    return int(found[1]) * 1024 / 1e6


def say_everything(session: zenoh.Session) -> zenoh.LivelinessToken:
    """All that a stranger could want to say; the liveliness token that it declares."""
    for key in (
        key_expressions.hand(FLEET, 2),
        key_expressions.hand(FLEET, 1),
        key_expressions.stop(FLEET),
        f"{FLEET}/**",
    ):
        session.put(key, ATTACK)
    return session.liveliness().declare_token(key_expressions.alive(FLEET, 2, "agent"))


# ---------------------------------------------------------------------- who is not let in


def strangers(fleet: Fleet, kind: str) -> tuple[str, dict[str, Any]]:
    """Endpoint and TLS settings of somebody who must not be let in."""
    known = str(Files(fleet.folder / "robot-1", of_robot(FLEET, 1)).authority)
    if kind == "plain TCP":
        return fleet.endpoint("tcp"), {}
    if kind == "no certificate":
        return fleet.endpoint(), {"root_ca_certificate": known}
    if kind == "another authority":
        with authority(fleet.folder / "other", fleet.now_s) as other:
            folder = fleet.make(of_robot(FLEET, 2), by=other, folder="stranger")
    else:
        folder = fleet.make(of_robot(FLEET, 2), at_s=fleet.now_s - AGO_S, folder="stranger")
    files = Files(folder, of_robot(FLEET, 2))
    return fleet.endpoint(), tls_settings(known, str(files.certificate), str(files.key))


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("no certificate", "it has no certificate"),
        ("another authority", "its certificate is not from this fleet's authority"),
        ("expired", "its certificate has expired"),
        ("plain TCP", "it does not speak TLS"),
    ],
)
def test_strangers_are_not_let_in(fleet: Fleet, kind: str, why: str) -> None:
    endpoint, tls = strangers(fleet, kind)
    with attacks(endpoint, None, **{"transport/link/tls": tls} if tls else {}) as session:
        token = say_everything(session)
        assert fleet.one.refuses("a connection of somebody").startswith(f"a connection of somebody: {why}")
        token.undeclare()
    fleet.end()
    assert fleet.one.got == []
    assert key_expressions.alive(FLEET, 2, "agent") not in fleet.one.alive


@pytest.mark.long
def test_who_listens_at_an_address_that_is_not_his(fleet: Fleet) -> None:
    """Somebody who has taken a robot's address, with the certificate of another robot, is not talked to."""
    listening = f"tls/127.0.0.3:{fleet.port + 1}"
    robot_2 = security(fleet.folder / "robot-2", of_robot(FLEET, 2))
    with Bus(listen=[listening], connect=[], security=robot_2):
        folder = fleet.make(of_robot(FLEET, 1), folder="dialler")
        with Guarded(folder, of_robot(FLEET, 1), [], [listening]) as dialler:
            line = dialler.refuses("the connection to")
            assert line.startswith(f"the connection to {listening}: its certificate is for other addresses")


@pytest.mark.long
def test_connections_that_say_nothing_keep_nobody_out(fleet: Fleet) -> None:
    silent = [socket.create_connection((ADDRESS, fleet.port)) for _ in range(40)]
    try:
        begun_s = time.monotonic()
        with Guarded(fleet.folder / "robot-2", of_robot(FLEET, 2), [], [fleet.endpoint()]) as two:
            two.hears(1)
        measured("let in beside silent ones after, s", time.monotonic() - begun_s)
    finally:
        for connection in silent:
            connection.close()


# ---------------------------------------------------------------------- who may not say what


def test_a_robot_says_only_what_is_its_own(fleet: Fleet) -> None:
    robot_2 = security(fleet.folder / "robot-2", of_robot(FLEET, 2))
    own = key_expressions.beacon(FLEET, 2)
    with attacks(fleet.endpoint(), robot_2, id=SHORT_ID) as session:
        heard(session, own)
        tokens = [session.liveliness().declare_token(key_expressions.alive(FLEET, 2, "agent"))]
        fleet.one.wait(
            lambda what: what.get("alive") == key_expressions.alive(FLEET, 2, "agent"), "robot 2 is there"
        )
        for key in (
            key_expressions.hand(FLEET, 1),
            key_expressions.hand(FLEET, 3),
            key_expressions.relayed(FLEET, 1),
            key_expressions.wrench(FLEET, 1),
            key_expressions.hand(FLEET, "*"),
            key_expressions.of_robot(FLEET, 2) + "anything",  # which nobody takes, but all would receive
            key_expressions.of_robot(FLEET, 2) + "**",
            f"{FLEET}/robot/**",
            f"{FLEET}/*",
            f"{FLEET}/**",
            "**",
            key_expressions.mission(FLEET),
            key_expressions.stop(FLEET),
            key_expressions.resume(FLEET),
            key_expressions.faults(FLEET),
            key_expressions.heartbeat(FLEET),
            key_expressions.ask(FLEET),
            key_expressions.events(FLEET),
            f"{FLEET}/alive/robot/1/agent",
        ):
            session.put(key, ATTACK)
        session.put(key_expressions.hand(FLEET, 2), bytes(PAYLOAD_BYTES_MAX + 1))
        session.delete(key_expressions.hand(FLEET, 2))
        for robot in (1, 3, "*"):
            tokens.append(session.liveliness().declare_token(key_expressions.alive(FLEET, robot, "plant")))
        session.put(own, ATTACK)  # comes after all of them, and is let through
        fleet.one.wait(lambda what: what.get("got") == own, "what robot 2 may say")
        line = fleet.one.refuses("a message")
        assert line.startswith(f"a message of {FLEET}.robot.2 that it may not send, or that is too large")
    fleet.end()
    assert fleet.one.got == [own]
    assert fleet.one.alive == {key_expressions.alive(FLEET, robot, "agent") for robot in (1, 2, 3)}


def test_an_operator_gives_orders_and_is_no_robot(fleet: Fleet) -> None:
    folder = fleet.make(of_operator(FLEET))
    stop = encode(Stop(1, time.time_ns(), "for a test"))
    sealed = Sealer(load(folder, of_operator(FLEET), time.time())).seal(stop, time.time_ns())
    with attacks(fleet.endpoint(), security(folder, of_operator(FLEET))) as session:
        heard(session, key_expressions.hand(FLEET, 2))
        session.put(key_expressions.hand(FLEET, 1), ATTACK)
        session.put(key_expressions.stop(FLEET), ATTACK)
        session.put(key_expressions.stop(FLEET), sealed.replace(b"for a test", b"for a tets"))
        session.put(key_expressions.stop(FLEET), sealed)
        fleet.one.refuses(f"a message of {FLEET}.operator.main")
        fleet.one.refuses(f"an order on {key_expressions.stop(FLEET)}: malformed")
        fleet.one.refuses(f"an order on {key_expressions.stop(FLEET)}: bad signature")
        fleet.one.wait(lambda what: what.get("payload") == stop.hex(), "the order")
    fleet.end()
    assert fleet.one.got == [key_expressions.stop(FLEET)]


@pytest.mark.long
def test_a_robot_tells_again_what_an_operator_said_and_nothing_else(fleet: Fleet) -> None:
    folder = fleet.make(of_operator(FLEET))
    stop = encode(Stop(1, time.time_ns(), "for a test"))
    sealed = Sealer(load(folder, of_operator(FLEET), time.time())).seal(stop, time.time_ns())
    told = key_expressions.relayed(FLEET, 2)
    with attacks(fleet.endpoint(), security(fleet.folder / "robot-2", of_robot(FLEET, 2))) as session:
        heard(session, key_expressions.hand(FLEET, 2))
        session.put(told, stop)
        session.put(told, sealed.replace(b"for a test", b"for a tets"))
        session.put(told, sealed)
        fleet.one.refuses(f"an order on {told}: malformed")
        fleet.one.refuses(f"an order on {told}: bad signature")
        fleet.one.wait(lambda what: what.get("payload") == stop.hex(), "the order")
    fleet.end()
    assert fleet.one.got == [told]


def test_who_is_none_of_the_fleet_is_told_nothing(fleet: Fleet) -> None:
    """Not even who listens to what, whoever has signed the certificate."""
    eve = of_operator(FLEET, "eve")  # not one of network.operators
    folder = fleet.make(eve)
    with attacks(fleet.endpoint(), security(folder, eve)) as session:
        publisher = session.declare_publisher(key_expressions.hand(FLEET, 2))
        with session.declare_subscriber(key_expressions.hand(FLEET, 1), zenoh.handlers.RingChannel(8)) as ear:
            fleet.one.refuses(f"a message of {eve.common_name}")
            with attacks(fleet.endpoint(), security(fleet.folder / "robot-2", of_robot(FLEET, 2))) as two:
                heard(two, key_expressions.beacon(FLEET, 2))  # by then she would have been told as well
            assert not publisher.matching_status.matching
            assert ear.try_recv() is None
    fleet.end()


@pytest.mark.long
def test_a_flood_of_what_is_refused(fleet: Fleet) -> None:
    """Neither the honest nor the log suffer."""
    robot_2 = security(fleet.folder / "robot-2", of_robot(FLEET, 2))
    with attacks(fleet.endpoint(), robot_2) as session:
        heard(session, key_expressions.hand(FLEET, 2))
        until_s, sent = time.monotonic() + 2.0, 0
        while time.monotonic() < until_s:
            session.put(key_expressions.stop(FLEET), ATTACK, congestion_control=zenoh.CongestionControl.BLOCK)
            sent += 1
        fleet.one.refuses("a message")
    measured("refused a second", sent / 2.0)
    fleet.end()
    assert fleet.one.got == []
    assert sum("refused" in what for what in fleet.one.told) <= 4  # two kinds, and again at the end


@pytest.mark.long
def test_messages_without_end_take_no_memory(fleet: Fleet) -> None:
    """Who has a robot's key and sends what is far too large fills nobody's memory while it comes in."""
    own = key_expressions.beacon(FLEET, 2)
    with attacks(fleet.endpoint(), security(fleet.folder / "robot-2", of_robot(FLEET, 2))) as session:
        heard(session, own)
        before_mb = peak_mb(fleet.one.process.pid)
        for _ in range(4):
            session.put(own, bytes(HUGE), congestion_control=zenoh.CongestionControl.BLOCK)

        def comes_through() -> bool:
            session.put(own, ATTACK)
            return own in fleet.one.got

        wait_for(comes_through, "what comes after it")
        grown_mb = measured("grown, MB", peak_mb(fleet.one.process.pid) - before_mb)
    fleet.end()
    assert grown_mb < 0.25 * HUGE / 1e6


# ---------------------------------------------------------------------- through a router


def test_a_router_looks_at_everybody(tmp_path: Path, port: int) -> None:
    """Robots behind it are its clients; what one may not say, it does not pass on."""
    now_s, endpoint = time.time(), f"tls/{ADDRESS}:{port}"
    with authority(tmp_path / "authority", now_s) as by:
        folders = {}
        for identity in (of_router(FLEET), of_operator(FLEET), *(of_robot(FLEET, n) for n in (1, 2))):
            folders[identity] = tmp_path / identity.common_name
            credentials(by, folders[identity], identity, (ADDRESS,), now_s)
        operators = load(folders[of_operator(FLEET)], of_operator(FLEET), now_s)
        sealed = Sealer(operators).seal(encode(Resume(1, time.time_ns(), ())), time.time_ns())
        robot_1, robot_2 = of_robot(FLEET, 1), of_robot(FLEET, 2)
        with (
            Guarded(folders[of_router(FLEET)], of_router(FLEET), [endpoint], []) as router,
            Guarded(folders[robot_1], robot_1, [], [], [endpoint]) as one,
            attacks(endpoint, security(folders[robot_2], robot_2), "client") as two,
            attacks(
                endpoint, security(folders[of_operator(FLEET)], of_operator(FLEET)), "client"
            ) as operator,
        ):
            heard(two, key_expressions.beacon(FLEET, 2))
            heard(operator, key_expressions.resume(FLEET))
            token = two.liveliness().declare_token(key_expressions.alive(FLEET, 2, "agent"))
            forged = two.liveliness().declare_token(key_expressions.alive(FLEET, 1, "plant"))
            for key in (key_expressions.hand(FLEET, 1), key_expressions.hand(FLEET, "*")):
                two.put(key, ATTACK)
            two.put(key_expressions.stop(FLEET), sealed)  # genuine, but not where a robot may say it
            two.put(key_expressions.beacon(FLEET, 2), ATTACK)
            operator.put(key_expressions.resume(FLEET), sealed)
            for key in (key_expressions.beacon(FLEET, 2), key_expressions.resume(FLEET)):
                one.wait(lambda what, key=key: what.get("got") == key, key)  # type: ignore[misc]
            one.wait(
                lambda what: what.get("alive") == key_expressions.alive(FLEET, 2, "agent"), "robot 2 is there"
            )
            router.refuses(f"a message of {FLEET}.robot.2")
            assert token is not forged
        assert sorted(one.got) == sorted([key_expressions.beacon(FLEET, 2), key_expressions.resume(FLEET)])
        assert one.alive == {key_expressions.alive(FLEET, robot, "agent") for robot in (1, 2)}
