"""A small secured fleet as real processes, one of whose robots somebody has taken over."""

from __future__ import annotations

import secrets
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.security.credentials import Files, load
from handfast.agent.security.identity import MAIN, Identity, Security, of_operator, of_robot, of_router
from handfast.agent.transport.bus import Bus
from handfast.agent.transport.sealed_bus import gate_of
from handfast.deploy.inventory.certificate_authority import Authority
from tests.process.fleet_harness import ROUTER, Robots, placed
from tests.process.harness import ADDRESS
from tests.process.small_fleets import TRIANGLE
from tests.trusted import authority, credentials

EAR: Final = "anna"
"""The operator that the tests listen as; `handfast drive` is of the main one."""
TAKEN: Final = 2
"""The robot that somebody has taken over: who has its key, and speaks over its agent's links."""
AGO_S: Final = 400 * 86_400.0


class Keys:
    """Credentials of a fleet's robots and operators, and those that strangers have. A context manager."""

    def __init__(self, fleet: Fleet, folder: Path) -> None:
        self.name, self.folder, self._fleet = fleet.fleet.name, folder, fleet
        self.now_s = time.time()
        self._by = authority(folder / "authority", self.now_s - AGO_S, self.name)
        self._other = authority(folder / "other-authority", self.now_s, self.name)
        routers = [of_router(self.name)] if fleet.routers else []
        for identity in (*map(self.robot, fleet.ids), self.operator(), self.operator(EAR), *routers):
            self.give(identity, self.now_s)

    def __enter__(self) -> Keys:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._by.close()
        self._other.close()

    def robot(self, robot: int) -> Identity:
        return of_robot(self.name, robot)

    def operator(self, name: str = MAIN) -> Identity:
        return of_operator(self.name, name)

    def of(self, identity: Identity) -> Path:
        """Where the genuine credentials of `identity` are."""
        return self.folder / str(identity).replace(" ", "-")

    def give(self, identity: Identity, at_s: float) -> None:
        """Gives `identity` genuine ones in the place of what it has, as signed at `at_s` (wall time)."""
        credentials(self._by, self.of(identity), identity, (ADDRESS,), at_s)

    def files(self, identity: Identity) -> Files:
        """The genuine ones of `identity`."""
        return Files(self.of(identity), identity)

    def expired(self, identity: Identity) -> Files:
        """What was genuine once."""
        return self._made(self._by, "expired", identity, self.now_s - AGO_S)

    def foreign(self, identity: Identity) -> Files:
        """What another authority has signed for the same name."""
        return self._made(self._other, "foreign", identity, self.now_s)

    def _made(self, by: Authority, folder: str, identity: Identity, at_s: float) -> Files:
        made = Files(self.folder / f"{folder}-{identity.common_name}", identity)
        if not made.key.exists():
            credentials(by, made.folder, identity, (ADDRESS,), at_s)
        return made

    def security(self, identity: Identity) -> Security:
        """What a genuine session of `identity` has."""
        files = self.files(identity)
        return Security(
            *(identity, str(files.authority), str(files.certificate), str(files.key)),
            *(self._fleet.ids, self._fleet.network.operators),
        )


class Ear(Bus):
    """An operator on the bus of a fleet.

    Attributes:
        given: the first order that it has given of each kind, as it was on the bus: all of the fleet have it.
    """

    def __init__(self, fleet: Fleet, at: Keys, connect: list[str]) -> None:
        identity = at.operator(EAR)
        found = load(at.of(identity), identity, at.now_s)
        self._gate = gate_of(fleet, found, lambda _: None)
        self.given: dict[str, bytes] = {}
        ends: dict[str, Any] = {"listen": [], "connect": () if fleet.routers else connect}
        routers = fleet.router_endpoints
        super().__init__(**ends, routers=routers, security=at.security(identity), go_on_waiting=lambda: True)

    def publish(self, key: str, payload: bytes) -> None:
        sealed = self._gate.let_out(key, payload, time.time_ns())
        assert sealed is not None
        self.given.setdefault(key, sealed)
        super().publish(key, sealed)

    def drain(self) -> Sequence[tuple[str, bytes]]:
        found = [(key, self._gate.let_in(key, payload, time.time_ns())) for key, payload in super().drain()]
        return [(key, opened) for key, opened in found if opened is not None]


class SecuredRobots(Robots):
    """`Robots` with keys. Over the links of the agent of robot `TAKEN` goes what `says` is told as well."""

    def __init__(self, fleet: Fleet, folder: Path, at: Keys) -> None:
        super().__init__(fleet, folder)
        self.keys = at
        self._mouth = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        # Not in the test's folder: names of sockets are short.
        self._short = tempfile.TemporaryDirectory(prefix="hf-")
        self._path = f"{self._short.name}/mouth"

    def __enter__(self) -> SecuredRobots:
        fleet = self.fleet
        self.endpoints = {
            **{(robot, "agent"): fleet.agent_endpoint(robot) for robot in fleet.ids},
            **{(robot, "plant"): fleet.plant_endpoint(robot) for robot in fleet.ids},
        }
        self.start_routers()
        self.bus = self.ear = Ear(fleet, self.keys, list(self.endpoints.values()))
        for key in (key_expressions.mission, key_expressions.stop, key_expressions.resume):
            self.bus.declare(key(self.name))
        self.bus.subscribe(key_expressions.everything(self.name), 65_536)
        self.presence = self.bus.watch(key_expressions.alive(self.name, "*", "*"))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self._mouth.close()
        self._short.cleanup()

    def start(self, robot: int, role: str, *more: str) -> None:
        arguments = [
            *("--fleet", str(self.fleet_file), "--robot", str(robot)),
            *("--keys", str(self.keys.of(self.keys.robot(robot))), "--orders", str(self.folder / "orders")),
            *more,
        ]
        if (robot, role) == (TAKEN, "agent"):
            self.run(robot, role, "tests.process.taken_over", self._path, *arguments)
        else:
            self.run(robot, role, f"handfast.{role}", *arguments)

    def start_router(self, number: int) -> None:
        keys = str(self.keys.of(of_router(self.name)))
        arguments = ("--fleet", str(self.fleet_file), "--number", str(number), "--keys", keys)
        self.run(number, ROUTER, "handfast.agent.runtime.router", *arguments)

    def says(self, key: str, payload: bytes) -> None:
        """The agent that was taken over says something; without payload, that `key` lives and is gone."""
        self._mouth.sendto(key.encode() + b"\0" + payload, self._path)

    def log_of(self, robot: int, role: str) -> str:
        return self.log(robot, role).read_text(errors="replace")


def three(*overrides: str) -> Fleet:
    """Three robots that go on along a line, on secured links, under a name of their own; resolved."""
    members = TRIANGLE.rpartition("[[robot]]")[0]
    own = (
        f'fleet.name="t-{secrets.token_hex(4)}"',
        'network.security="mtls"',
        f'network.operators=["{MAIN}", "{EAR}"]',
    )
    return resolved(parse_fleet(members, source="three", overrides=[*own, *overrides]))


@contextmanager
def secured_robots(fleet: Fleet, folder: Path) -> Iterator[SecuredRobots]:
    """Every process of a fleet (resolved, secured), ready for a mission."""
    with ExitStack() as stack:
        here = stack.enter_context(placed(fleet))
        at = stack.enter_context(Keys(here, folder / "keys"))
        all_robots = stack.enter_context(SecuredRobots(here, folder, at))
        all_robots.start_all()
        all_robots.wait_until_all("ready")
        yield all_robots
