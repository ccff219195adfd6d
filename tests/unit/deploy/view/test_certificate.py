"""A page's server at an address of the network proves who it is by the fleet's authority, or is not there."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from pathlib import Path

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.security.credentials import AUTHORITY_CERTIFICATE
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.certificate_authority import INDEX_FILE
from handfast.deploy.inventory.operator_credentials import KEYS
from handfast.deploy.view.server import address_of, tls_of
from tests.trusted import authority

HERE = "127.0.0.2"


def fleet(*more: str) -> Fleet:
    return parse_fleet(
        """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0.2 }]
fleet = { name = "two", rate_hz = 50 }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
trajectory = { kind = "line", velocity_mps = [0.1, 0.0] }
""",
        source="two",
        overrides=list(more),
    )


SECURED = fleet('network.security="mtls"')


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The operator's folder, in which the authority is."""
    monkeypatch.setenv(KEYS, str(tmp_path / "keys"))
    authority(tmp_path / "keys", time.time(), "two").close()
    return tmp_path / "keys"


def served(context: ssl.SSLContext, at: str, trusts: ssl.SSLContext, name: str) -> bytes:
    """What a client is told who calls a server at `at` by a `name`."""
    with socket.create_server((at, 0)) as listening:

        def answer() -> None:
            connection, _ = listening.accept()
            try:
                with context.wrap_socket(connection, server_side=True) as secured:
                    secured.sendall(b"here")
            except OSError:
                connection.close()

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            with (
                socket.create_connection(listening.getsockname(), 10) as plain,
                trusts.wrap_socket(plain, server_hostname=name) as secured,
            ):
                return secured.recv(10)
        finally:
            thread.join()


def test_browsers_that_trust_the_authority_trust_the_page(keys: Path) -> None:
    context = tls_of(SECURED, HERE, 0)
    trusts = ssl.create_default_context(cafile=str(keys / AUTHORITY_CERTIFICATE))
    assert served(context, HERE, trusts, HERE) == b"here"
    with pytest.raises(ssl.SSLCertVerificationError):
        served(context, HERE, trusts, "127.0.0.3")
    with pytest.raises(ssl.SSLCertVerificationError):
        served(context, HERE, ssl.create_default_context(), HERE)
    old = ssl.create_default_context(cafile=str(keys / AUTHORITY_CERTIFICATE))
    old.maximum_version = ssl.TLSVersion.TLSv1_2
    with pytest.raises(ssl.SSLError):
        served(context, HERE, old, HERE)


def test_its_key_is_in_no_file(keys: Path) -> None:
    before = {path.name for path in keys.iterdir()}
    tls_of(SECURED, HERE, 0)
    assert {path.name for path in keys.iterdir()} == before | {INDEX_FILE}  # which names all it has signed


def test_a_fleet_that_is_not_secured_is_not_served(keys: Path) -> None:
    with pytest.raises(
        InputError, match=r"--listen 127.0.0.2: two is not secured.*ssh -L 8123:127.0.0.1:8123"
    ):
        tls_of(fleet(), HERE, 8123)


def test_without_the_authority_no_other_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEYS, str(tmp_path / "keys"))
    with pytest.raises(InputError, match="authority of two is not on this machine"):
        tls_of(SECURED, HERE, 0)
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize(
    ("text", "address"), [("127.0.0.2", "127.0.0.2"), ("[::1]", "::1"), ("Lab-PC", "lab-pc")]
)
def test_addresses(text: str, address: str) -> None:
    assert address_of(text) == address


@pytest.mark.parametrize("text", ["0.0.0.0", "::", "1.2.3", "a b", "", "http://x/"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--listen"):
        address_of(text)
