"""Who attacks a secured fleet: what they have, and what they say."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import zip_longest
from math import nan
from struct import pack
from typing import Any, Final, Literal
from zlib import crc32

import msgpack
import zenoh
from cryptography.hazmat.primitives.asymmetric.ec import ECDSA
from cryptography.hazmat.primitives.hashes import SHA256

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import (
    BYTES_MAX,
    NO_FORCES,
    Ask,
    Beacon,
    Faults,
    HandState,
    Heartbeat,
    Message,
    Mission,
    PlantState,
    Removed,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.agent.security.credentials import Credentials, Files, load
from handfast.agent.security.identity import tls_settings
from handfast.agent.security.sealed_order import DOMAIN, VERSION
from handfast.agent.transport.bus import PAYLOAD_BYTES_MAX, settings_of
from tests.process.harness import wait_for
from tests.process.secured_fleet import TAKEN, Keys

Say = Callable[[str, bytes], None]
FAR: Final = 900.0
"""m; and as many m/s and N."""
AHEAD_NS: Final = NS_PER_S // 5
"""A stamp that far ahead is still believed, and all that is genuine is older."""
LONG_AGO_NS: Final = 60 * NS_PER_S
CHECKSUM_BYTES: Final = 5
CUT: Final = '[[faults.rule]]\nloss = "100%"\n'


@contextmanager
def attacks(
    endpoints: Sequence[str], settings: dict[str, Any], mode: Literal["peer", "client"] = "peer"
) -> Iterator[zenoh.Session]:
    """A session that does not check what it hears, and does not mind what it sends."""
    made = zenoh.Config()
    base = settings_of(mode, [], endpoints, None) | settings
    free = {"access_control": {"enabled": False}, "low_pass_filter": []}
    for path, value in (base | free).items():
        made.insert_json5(path, json.dumps(value))
    with zenoh.open(made) as session:
        yield session


def strangers(at: Keys) -> dict[str, tuple[str, dict[str, Any]]]:
    """By who they are: what the fleet says of them, and the settings of their sessions."""
    robot = at.robot(TAKEN)
    known = str(at.files(robot).authority)

    def with_(files: Files) -> dict[str, Any]:
        return {"transport/link/tls": tls_settings(known, str(files.certificate), str(files.key))}

    return {
        "no certificate": (
            "it has no certificate",
            {"transport/link/tls": {"root_ca_certificate": known}},
        ),
        "another authority": (
            "its certificate is not from this fleet's authority",
            with_(at.foreign(robot)),
        ),
        "another authority's operator": (
            "its certificate is not from this fleet's authority",
            with_(at.foreign(at.operator())),
        ),
        "expired": ("its certificate has expired", with_(at.expired(robot))),
        "plain TCP": ("it does not speak TLS", {}),
    }


@contextmanager
def sockets(endpoints: Sequence[str]) -> Iterator[Callable[[], None]]:
    """Connections that say nothing, nonsense, or a handshake byte by byte: one more byte for each call."""
    hello = bytes.fromhex("160301020001 0001fc0303") + bytes(500)
    silent: list[socket.socket] = []
    slow: list[list[Any]] = []
    for endpoint in endpoints:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        for request in (b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n", os.urandom(4096), bytes(4096)):
            with socket.create_connection((host, int(port))) as garbage:
                garbage.sendall(request)
        silent += [socket.create_connection((host, int(port))) for _ in range(8)]
        slow += [[socket.create_connection((host, int(port))), 0] for _ in range(2)]

    def one_more() -> None:
        for each in slow:
            connection, sent = each
            try:
                connection.sendall(hello[sent : sent + 1])
                each[1] += 1
            except OSError:
                pass  # refused, which is as good

    try:
        yield one_more
    finally:
        for connection in (*silent, *(each[0] for each in slow)):
            connection.close()


def heard(session: zenoh.Session, *where: str) -> None:
    """Waits until somebody listens: what is said before is lost."""
    for key in where:
        publisher = session.declare_publisher(key)
        wait_for(lambda said=publisher: said.matching_status.matching, f"somebody listens to {key}")  # type: ignore[misc]
        publisher.undeclare()  # type: ignore[no-untyped-call]


# ---------------------------------------------------------------------- what they say


@cache
def _found(files: Files) -> Credentials:
    return load(files.folder, files.identity, time.time())


def sealed(files: Files, payload: bytes, now_ns: int) -> bytes:
    """A seal with a key that may be nobody's who gives orders."""
    found = _found(files)
    signature = found.key.sign(DOMAIN + pack(">Q", now_ns) + payload, ECDSA(SHA256()))
    packed: bytes = msgpack.packb((VERSION, now_ns, found.certificate.der, signature, payload))
    return packed


def as_robot(fleet: str, robot: int, now_ns: int) -> dict[str, bytes]:
    """All that robot `robot` says of itself, newer than what it says, and absurd: key -> payload."""
    then_ns, number = now_ns + AHEAD_NS, 1 << 40
    place = (FAR, -FAR, FAR, FAR)
    said: dict[str, Message] = {
        key_expressions.hand(fleet, robot): HandState(
            robot, number, then_ns, True, 2, *place, *NO_FORCES, 0.0, ((1, FAR), (3, FAR)), ()
        ),
        key_expressions.beacon(fleet, robot): Beacon(
            robot, number, then_ns, True, *place, 0.0, 0, 0, number, -1
        ),
        key_expressions.status(fleet, robot): Status(
            robot, number, then_ns, "fault", "", "attack", 0, number, (), (), (), ()
        ),
        key_expressions.plant_state(fleet, robot): PlantState(
            robot, number, then_ns, *place, FAR, FAR, FAR, True, False, False, "attack"
        ),
        key_expressions.wrench(fleet, robot): Wrench(robot, number, then_ns, FAR, FAR, False),
    }
    return {key: encode(message) for key, message in said.items()}


def orders(fleet: Fleet, now_ns: int, at_ns: int) -> dict[str, bytes]:
    """Every order of `fleet`, newer than any that was given, not sealed: key -> payload.

    Args:
        at_ns: when it was made.
    """
    name, version = fleet.fleet.name, now_ns // 1_000 + 3_600_000_000
    said: dict[str, Message] = {
        key_expressions.stop(name): Stop(version, at_ns, "attack"),
        key_expressions.mission(name): Mission(
            version, at_ns, now_ns, 1, digest(fleet), note="attack", removed=(Removed(TAKEN, at_ns),)
        ),
        key_expressions.resume(name): Resume(version + 1, at_ns, ()),
        key_expressions.faults(name): Faults(version, at_ns, "attack", at_ns, 600 * NS_PER_S, CUT),
        key_expressions.heartbeat(name): Heartbeat(at_ns, "attack"),
        key_expressions.ask(name): Ask(at_ns, "attack"),
    }
    return {key: encode(message) for key, message in said.items()}


def _whole(array: bytes) -> bytes:
    """With a right checksum, so that it is looked at."""
    return array + pack(">BI", 0xCE, crc32(array))


def malformed(fleet: str, now_ns: int) -> list[bytes]:
    """Nonsense, some of it nearly right."""
    whole = as_robot(fleet, TAKEN, now_ns)[key_expressions.hand(fleet, TAKEN)]
    fields = msgpack.unpackb(whole[:-CHECKSUM_BYTES])
    return [
        b"\0",
        b"\x91" * 500,
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff" + bytes(64),
        _whole(b"\x91" * 500),
        _whole(msgpack.packb(["attack"] * 20)),
        _whole(msgpack.packb([nan if field == FAR else field for field in fields])),
        whole[:-1],
        whole + whole,
        os.urandom(200),
    ]


OVERSIZED: Final = tuple(bytes(size) for size in (BYTES_MAX + 1, PAYLOAD_BYTES_MAX, PAYLOAD_BYTES_MAX + 1))
"""For the codec, the seal and the link."""


def own_keys(fleet: str) -> list[str]:
    """Where robot `TAKEN` may say something, but for what it tells of orders."""
    return [
        key(fleet, TAKEN)
        for key in (
            key_expressions.hand,
            key_expressions.beacon,
            key_expressions.status,
            key_expressions.plant_state,
            key_expressions.wrench,
            key_expressions.links,
            key_expressions.checks,
        )
    ]


def say_as_others(say: Say, fleet: Fleet, at: Keys, given: dict[str, bytes]) -> None:
    """What a robot may not say: what others say of themselves, and orders, whoever has sealed them."""
    name, now_ns = fleet.fleet.name, time.time_ns()
    for robot in (1, 3):
        for key, payload in as_robot(name, robot, now_ns).items():
            say(key, payload)
            say(key.replace(f"robot/{robot}", "robot/*"), payload)
    say(f"{name}/**", as_robot(name, 1, now_ns)[key_expressions.hand(name, 1)])
    robot_2, operator = at.robot(TAKEN), at.operator()
    for key, payload in orders(fleet, now_ns, now_ns).items():
        say(key, payload)
        say(key, sealed(at.files(robot_2), payload, now_ns))
        say(key, sealed(at.foreign(operator), payload, now_ns))
    for key, payload in (given | overheard(fleet, at)).items():
        say(key, payload)


def overheard(fleet: Fleet, at: Keys) -> dict[str, bytes]:
    """Genuine orders of a minute ago that are said once and not again, byte by byte."""
    then_ns = time.time_ns() - LONG_AGO_NS
    main = at.operator()
    once = (
        key_expressions.faults(fleet.fleet.name),
        key_expressions.heartbeat(fleet.fleet.name),
        key_expressions.ask(fleet.fleet.name),
    )
    return {
        key: sealed(at.files(main), payload, then_ns)
        for key, payload in orders(fleet, then_ns, then_ns).items()
        if key in once
    }


def say_on_own_keys(
    say: Say, fleet: Fleet, at: Keys, given: dict[str, bytes], more: Sequence[bytes], turn: int
) -> None:
    """What comes through to whoever listens, and must change nothing there.

    Args:
        given: genuine orders of before.
        more: to be said on all of its keys, such as genuine messages of other robots.
        turn: counts up from one call to the next: with what it begins.
    """
    name, now_ns = fleet.fleet.name, time.time_ns()
    nonsense = [*malformed(name, now_ns), *more]
    for key in own_keys(name):
        for payload in nonsense:
            say(key, payload)
    plain = list(orders(fleet, now_ns, now_ns).values())
    kinds: list[list[bytes]] = [
        [*plain, *nonsense],
        [sealed(at.files(at.robot(TAKEN)), payload, now_ns) for payload in plain],
        [sealed(at.foreign(at.operator()), payload, now_ns) for payload in plain],
        [payload[:-1] + bytes([payload[-1] ^ 1]) for payload in given.values()],
        [bytes(PAYLOAD_BYTES_MAX)],
        [*given.values(), *overheard(fleet, at).values()],
    ]
    # Of what is forged only the first few are looked at: each kind is among them now and then.
    first = turn % len(kinds)
    for some in zip_longest(*kinds[first:], *kinds[:first]):
        for payload in filter(None, some):
            say(key_expressions.relayed(name, TAKEN), payload)
