"""The proxy before a robot's ports: strangers keep nobody out, and who they are is told.

Robot 1 listens behind it, and robot 3 dials it, from `ADDRESS`; strangers come from addresses of their own.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from agent.fleet.hosts import HostSection
from agent.fleet.loading import to_dict
from agent.messages import key_expressions
from agent.security.access_control import tls_settings
from agent.security.credentials import Files
from agent.security.identity import Identity, of_robot, of_router
from deploy.inventory.certificate_authority import Authority
from deploy.processes.ports import Reservation
from tests.process.attackers import attacks
from tests.process.flood import SAYS, source
from tests.process.flooding import flooding
from tests.process.guarded import guarded_fleet
from tests.process.harness import ADDRESS, environment, measured, no_trouble, wait_for
from tests.process.test_security_links import Guarded
from tests.trusted import FLEET, authority, credentials

pytestmark = pytest.mark.long

OUTSIDE = "127.0.0.2"
"""Where others reach robot 1; its processes are on `ADDRESS`."""
BASE_PORT = 21_760
FLOOD_PER_S = 200
SOURCES = 50


class Behind:
    """Robot 1 behind its proxy; leaving it ends both."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.port, self.now_s = folder, port, time.time()
        self.by = authority(folder / "authority", self.now_s)
        for robot in (1, 2, 3):
            self.make(of_robot(FLEET, robot), self.by, f"robot-{robot}")
        fleet = guarded_fleet()
        network = replace(
            fleet.network, address=OUTSIDE, base_port=port, admission="proxy", security="mtls", routers=()
        )
        self.fleet = replace(fleet, network=network)
        self.file = folder / "fleet.toml"
        self.file.write_text(tomli_w.dumps(to_dict(self.fleet)))
        self.proven = folder / "state" / "robot-1.proven.json"
        self.errors = folder / "proxy.stderr"
        self._begun = 0
        self.begin()
        self.one = Guarded(folder / "robot-1", of_robot(FLEET, 1), [*self.fleet.agent_listens(1)], [])
        self._processes: list[Guarded] = [self.one]

    def make(self, identity: Identity, by: Authority, folder: str) -> Path:
        made = self.folder / folder
        credentials(by, made, identity, (OUTSIDE,), self.now_s)
        return made

    def begin(self) -> None:
        """Starts the proxy, and waits until it is there."""
        with open(self.errors, "ab") as errors:
            self.proxy = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "agent.admission", "--fleet", str(self.file)),
                    *("--robot", "1", "--proven", str(self.proven)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                env=environment(),
                start_new_session=True,
            )
        begun = "lets connections through"
        wait_for(
            lambda: self.errors.read_text().count(begun) > self._begun, begun, report=self.errors.read_text
        )
        self._begun += 1

    def dialling(self, robot: int) -> Guarded:
        """A robot that dials robot 1 the way others do."""
        made = Guarded(
            self.folder / f"robot-{robot}", of_robot(FLEET, robot), [], [self.fleet.agent_endpoint(1)]
        )
        self._processes.append(made)
        made.wait(lambda what: "ready" in what, "it is ready")
        return made

    def refuses(self, text: str) -> str:
        """The line of the proxy's log that holds `text`."""

        def look() -> str:
            return next((line for line in self.errors.read_text().splitlines() if text in line), "")

        return wait_for(look, text, report=self.errors.read_text)

    def end(self) -> None:
        for process in reversed(self._processes):
            process.end()
        self.proxy.terminate()
        assert self.proxy.wait(10.0) == 0
        no_trouble(self.errors.read_text(), "the proxy's log")

    def kill(self) -> None:
        self.by.close()
        for process in self._processes:
            process.kill()
        self.proxy.kill()
        self.proxy.wait()


@pytest.fixture
def behind(tmp_path: Path) -> Iterator[Behind]:
    ports = Reservation(ADDRESS, BASE_PORT, 16)
    made = Behind(tmp_path, ports.base)
    try:
        made.one.wait(lambda what: "ready" in what, "it is ready")
        yield made
        made.end()
    finally:
        made.kill()
        ports.close()


@contextmanager
def flood(
    kind: str, port: int, rate: int = FLOOD_PER_S, addresses: Sequence[str] = (OUTSIDE,)
) -> Iterator[None]:
    """Strangers that try all the while."""
    with flooding([(address, port) for address in addresses], rate, kind, sources=SOURCES) as strangers:
        begun_s = time.monotonic()
        yield
        took_s = time.monotonic() - begun_s
        measured("connections a second", strangers.end() / took_s)


@pytest.mark.parametrize("kind", SAYS)
def test_who_was_there_before_comes_back_in_a_flood(behind: Behind, kind: str) -> None:
    behind.dialling(3).hears(1)
    with flood(kind, behind.port):
        behind.refuses("connections of 127.1.0.")
        begun_s = time.monotonic()
        behind.dialling(2).hears(1)
        measured("let in after, s", time.monotonic() - begun_s)


def test_who_comes_for_the_first_time_is_let_in_in_a_flood(behind: Behind) -> None:
    """Those that failed wait: it is before them."""
    with flood("broken", behind.port):
        behind.refuses("too soon after one that failed")
        behind.dialling(2).hears(1)


def test_nobody_without_a_certificate_is_taken_for_one_who_has_one(behind: Behind) -> None:
    known = str(Files(behind.folder / "robot-1", of_robot(FLEET, 1)).authority)
    with authority(behind.folder / "other", behind.now_s) as other:
        files = Files(behind.make(of_robot(FLEET, 2), other, "stranger"), of_robot(FLEET, 2))
    strangers = {
        "it has no certificate": {"root_ca_certificate": known},
        "not from this fleet's authority": tls_settings(known, str(files.certificate), str(files.key)),
    }
    for why, tls in strangers.items():
        with attacks([behind.fleet.agent_endpoint(1)], {"transport/link/tls": tls}):
            behind.one.refuses(why)
    assert behind.refuses(f"connections of {ADDRESS}: it has shown no certificate of this fleet")
    assert not behind.proven.exists()
    with socket.create_connection((OUTSIDE, behind.port), source_address=(source(7), 0)) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert plain.recv(1) == b""
    behind.refuses(f"connections of {source(7)}: it does not speak TLS")
    behind.dialling(2).hears(1)
    wait_for(behind.proven.exists, "it has proven itself")
    assert json.loads(behind.proven.read_text()) == [ADDRESS]


def test_links_come_back_when_the_proxy_was_killed(behind: Behind) -> None:
    three = behind.dialling(3)
    three.hears(1)
    behind.proxy.kill()
    behind.proxy.wait()
    one = key_expressions.alive(FLEET, 1, "agent")
    three.wait(lambda what: what.get("alive") == one and not what["here"], "its link is gone")
    three.told.clear()
    with flood("broken", behind.port):  # the proxy knows who was there before
        behind.begin()
        behind.refuses("connections of 127.1.0.")
        three.wait(lambda what: what.get("alive") == one and what["here"], "robot 1 is there again")


def test_without_its_memory_it_begins_anew(behind: Behind) -> None:
    behind.dialling(3).hears(1)
    wait_for(behind.proven.exists, "it has proven itself")
    behind.proxy.kill()
    behind.proxy.wait()
    behind.proven.write_text('["127.0.0.1", "an address"]')
    behind.begin()
    behind.refuses("begins without knowing who had a certificate")
    behind.dialling(2).hears(1)


def test_the_router_of_a_host_has_one_too(behind: Behind, tmp_path: Path) -> None:
    network = replace(behind.fleet.network, routers=("base",))
    routed = replace(behind.fleet, network=network, hosts=(HostSection("base", OUTSIDE),))
    (place,) = routed.routers
    file = tmp_path / "routed.toml"
    file.write_text(tomli_w.dumps(to_dict(routed)))
    router = of_router(FLEET)
    folder = behind.make(router, behind.by, "router")
    errors = tmp_path / "router.stderr"
    with ExitStack() as stack:
        proxy = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-P", "-m", "agent.admission", "--fleet", str(file), "--router", "1"],
                stdin=subprocess.DEVNULL,
                stderr=stack.enter_context(open(errors, "wb")),
                env=environment(),
                start_new_session=True,
            )
        )
        stack.callback(proxy.kill)
        wait_for(lambda: "lets connections through" in errors.read_text(), "it begins")
        stack.enter_context(Guarded(folder, router, [f"tls/{place.listens}"], []))
        two, three = (
            stack.enter_context(
                Guarded(tmp_path / f"robot-{robot}", of_robot(FLEET, robot), [], [], [f"tls/{place.where}"])
            )
            for robot in (2, 3)
        )
        two.hears(3)
        three.hears(2)
        for each in (two, three):
            each.end()
        proxy.terminate()
        assert proxy.wait(10.0) == 0
    said = errors.read_text()
    assert said.startswith(f"router 1 admission: lets connections through on tls/{place.where}\n")
    no_trouble(said, "the proxy's log")


def test_what_it_cannot_do_is_said(behind: Behind) -> None:
    with socket.create_server((OUTSIDE, behind.port + 3)):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "agent.admission", "--fleet", str(behind.file), "--robot", "2"],
            env=environment(),
            capture_output=True,
            text=True,
            timeout=30.0,
        )
    assert (done.returncode, done.stdout) == (1, "")
    said = f"robot 2 admission: cannot listen on tls/{OUTSIDE}:{behind.port + 3}: address already in use\n"
    assert done.stderr == said
