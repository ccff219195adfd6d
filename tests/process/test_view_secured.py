"""The page of a secured fleet at an address of the network: by TLS, with a token, for nobody else."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest
from playwright.sync_api import expect

from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE
from handfast.deploy.inventory.certificate_authority import INDEX_FILE
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, KEYS
from tests.process.chromium import opened
from tests.process.harness import Command, wait_for
from tests.process.page_talk import talked
from tests.process.secured_fleet import SecuredRobots, secured_robots, three
from tests.process.small_fleets import triangle

SLOW = ("fleet.rate_hz=25", "control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5")
HERE = "127.0.0.2"
"""Stands for an address of the network: it is not the one that a page has unless told otherwise."""


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SecuredRobots]:
    """Stands ready; this machine has an operator's credentials and the fleet's authority."""
    with secured_robots(three(*SLOW), tmp_path / "r") as all_robots:
        keys = tmp_path / "keys"
        shutil.copytree(all_robots.keys.of(all_robots.keys.operator()), keys)
        for name in (AUTHORITY_FILE, INDEX_FILE):
            shutil.copy2(all_robots.keys.folder / "authority" / name, keys / name)
        monkeypatch.setenv(KEYS, str(keys))
        all_robots.wait_until_all("ready")
        yield all_robots
        assert not all_robots.died(), all_robots.told()


def test_browsers_of_other_machines_come_by_tls_and_token(fleet: SecuredRobots, tmp_path: Path) -> None:
    arguments = ("view", str(fleet.fleet_file), "--listen", HERE, "--no-browser")
    with Command(tmp_path / "view", *arguments) as command:
        found = wait_for(lambda: re.search(r"https://\S+", command.out), "an address", report=command.told)
        assert found is not None
        address, _, token = found[0].partition("#token=")
        trusts = ssl.create_default_context(cafile=str(tmp_path / "keys" / AUTHORITY_CERTIFICATE))
        with urlopen(address, timeout=10, context=trusts) as answer:
            assert answer.status == 200
        with pytest.raises(OSError, match="certificate"):
            urlopen(address, timeout=10, context=ssl.create_default_context())
        port = int(address.rstrip("/").rpartition(":")[2])
        with socket.create_connection((HERE, port), 10) as plain:
            plain.sendall(f"GET / HTTP/1.1\r\nHost: {HERE}:{port}\r\n\r\n".encode())
            assert b"200" not in plain.recv(1000)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), 10)

        site, evil = address.rstrip("/"), {"order": {"id": "evil", "kind": "stop"}}
        for origin in (None, "https://evil.example", f"http://{HERE}:{port}", f"https://{HERE}"):
            assert talked(address, trusts, origin, {"token": token}, evil) == "Forbidden"
        for said in ("wrong", token[:-1], token + "x"):
            assert talked(address, trusts, site, {"token": said}, evil).startswith("another token")

        with opened(tmp_path, strange=True) as page:
            page.goto(found[0])
            page.wait_for_selector('body[data-exact="true"]')
            page.locator("#change button", has_text="start the mission").click()
            fleet.wait_until_all("running")
            expect(page.locator("#change li").first).to_contain_text("start the mission – 3 of 3")
            page.keyboard.press("Escape")
            expect(page.locator("#change li").first).to_contain_text("stop – 3 of 3")
        fleet.wait_until_all("stopped")
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130


@pytest.mark.long
@pytest.mark.parametrize(
    ("listen", "says"),
    [
        (HERE, ("--listen 127.0.0.2", "is not secured", "docs/security.md", "ssh -L")),
        ("0.0.0.0", ("--listen 0.0.0.0", "the one address")),
        ("not an address", ("--listen", "neither an IP address nor a host name")),
        ("", ("--listen", "address")),
    ],
)
def test_another_address_is_refused_without_a_secured_fleet(
    tmp_path: Path, listen: str, says: tuple[str, ...]
) -> None:
    import tomli_w

    from handfast.agent.fleet.loading import to_dict

    file = tmp_path / "fleet.toml"
    file.write_text(tomli_w.dumps(to_dict(triangle())))
    with Command(tmp_path / "view", "view", str(file), "--no-browser", "--listen", listen) as command:
        assert command.wait() == 2, command.told()
    assert command.out == ""
    for words in says:
        assert words in command.err, command.err
