"""The page of a secured fleet that is up on two hosts, served by the operator's computer, in the browser of
another one of their network. Each test goes on from the one before."""

from __future__ import annotations

import base64
import json
import re
import shlex
import signal
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest
from playwright.sync_api import Error, expect

from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE
from tests.hosts.computers import OPERATOR_ADDRESS
from tests.hosts.fleet_on_hosts import UP_TIMEOUT_S, FleetOnHosts, delta, fetch_wheels
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.hosts.test_stop_on_hosts import CALM, CAME_UP, PATIENT, ROBOTS, states
from tests.process.chromium import opened, program
from tests.process.harness import environment, no_trouble, wait_for
from tests.process.page_talk import SHOWN
from tests.process.test_view_live import DRIVES, first_order

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
ANOTHER_TOKEN: Final = "another token: open the address that handfast view printed"
SERVER: Final = f"https://{OPERATOR_ADDRESS}"
POLICIES: Final = "/etc/chromium/policies/managed"
"""Where a computer's administrator has Chromium trust an authority, among others."""


@pytest.fixture(scope="module")
def hosts(make_hosts: Callable[[int], Hosts]) -> Hosts:
    return make_hosts(3)


@pytest.fixture(scope="module")
def notebook(hosts: Hosts) -> Host:
    """A computer of the same network, none of the fleet's: somebody's who has a browser."""
    return hosts[2]


@pytest.fixture(scope="module")
def fleet(hosts: Hosts, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> FleetOnHosts:
    fetch_wheels(hosts[0], cache)
    tables = delta(list(hosts)[:2], fleet=CALM | {"duration_s": 300.0}, control=PATIENT)
    found = FleetOnHosts(hosts, tmp_path_factory.mktemp("fleet"), tables, cache)
    found.handfast("keys")
    found.handfast("up", timeout=UP_TIMEOUT_S)
    return found


@pytest.fixture(scope="module")
def authority(fleet: FleetOnHosts) -> Path:
    """The certificate of the fleet's authority."""
    return fleet.hosts.operator.home / ".config/handfast/keys" / fleet.name / AUTHORITY_CERTIFICATE


@pytest.fixture(scope="module")
def address(fleet: FleetOnHosts) -> Iterator[str]:
    """What `handfast view` on the operator's computer says that browsers are to open, with the token."""
    out, errors = fleet.folder / "view.out", fleet.folder / "view.err"
    words = fleet.words("view", "--listen", OPERATOR_ADDRESS, "--no-browser")
    with out.open("w") as stdout, errors.open("w") as stderr:
        command = fleet.hosts.operator.popen(
            words, fleet.environment(), cwd=fleet.folder, stdout=stdout, stderr=stderr
        )

    def told() -> str:
        return out.read_text() + errors.read_text()

    with command:
        try:
            found = wait_for(lambda: re.search(r"https://\S+", out.read_text()), "an address", report=told)
            assert found is not None
            yield found[0]
            command.send_signal(signal.SIGINT)
            assert command.wait(60.0) == 130, told()
            no_trouble(told(), "handfast view")
        finally:
            command.kill()


def browser_on(host: Host, folder: Path) -> Path:
    """A program that starts Chromium on a host, in all of its namespaces but that of users."""
    enter = [*host.space.command("mount", "net", "uts", "ipc", "pid"), program()]
    made = folder / f"chromium-on-{host.name}"
    made.write_text(f'#!/bin/sh\nexec {shlex.join(enter)} "$@"\n')
    made.chmod(0o755)
    return made


def trust(host: Host, authority: Path) -> None:
    """Has browsers of a host trust an authority, as its administrator would."""
    found = base64.b64encode(ssl.PEM_cert_to_DER_cert(authority.read_text())).decode()
    policy = json.dumps({"CACertificates": [found]})
    host.run(f"mkdir -p {POLICIES} && cat >{POLICIES}/handfast.json", input=policy, check=True)


def test_nobody_without_the_authority_the_token_and_the_page_itself_is_let_in(
    fleet: FleetOnHosts, notebook: Host, authority: Path, address: str, tmp_path: Path
) -> None:
    where, _, token = address.partition("#token=")
    done = subprocess.run(
        [
            *notebook.space.command("net"),
            *(sys.executable, "-P", "-m", "tests.hosts.page_visits", where, token, str(authority)),
        ],
        env=environment(),
        text=True,
        capture_output=True,
        timeout=60.0,
    )
    assert done.returncode == 0, done.stderr
    told: dict[str, str] = json.loads(done.stdout)
    assert "certificate verify failed" in told.pop("the world's authorities")
    assert "200" not in told.pop("in the clear")
    assert told == {
        "its authority": "OK",
        **dict.fromkeys(("no origin", "another site", "another scheme"), "Forbidden"),
        **dict.fromkeys(("no token", "another token"), ANOTHER_TOKEN),
        "the token": SHOWN,
    }
    browser = browser_on(fleet.hosts[0], tmp_path)
    with (
        opened(tmp_path, by=browser, servers=(SERVER,)) as page,
        pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"),
    ):
        page.goto(address)
    assert set(states(fleet).values()) == {CAME_UP}


def test_a_browser_that_trusts_the_authority_starts_the_mission_and_stops_it(
    fleet: FleetOnHosts, notebook: Host, authority: Path, address: str, tmp_path: Path
) -> None:
    trust(notebook, authority)
    with opened(tmp_path, by=browser_on(notebook, tmp_path), servers=(SERVER,)) as page:
        page.goto(address)
        page.wait_for_selector('body[data-exact="true"]')
        rows = page.locator("#robots tbody tr")
        expect(rows).to_have_count(len(ROBOTS))
        expect(rows.filter(has_text="stopped")).to_have_count(len(ROBOTS))  # as they came up
        page.locator("#change label", has_text="also after a stop").click()
        page.locator("#change button", has_text="start the mission").click()
        first_order(page, "start the mission – 6 of 6")
        wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive", 30.0)
        expect(rows.filter(has_text=DRIVES)).to_have_count(len(ROBOTS))
        page.locator("#stop").click()
        first_order(page, "stop – 6 of 6")
        assert set(states(fleet).values()) <= {"stopping: stop", "stopped: stop"}  # all brake
        wait_for(lambda: set(states(fleet).values()) == {"stopped: stop"}, "all stand", 10.0)
        expect(rows.filter(has_text="stopped")).to_have_count(len(ROBOTS))
