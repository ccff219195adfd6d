"""A backup of the authority, and its restoration."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path

import pytest

from handfast.agent.security.credentials import wanting
from handfast.agent.security.identity import of_operator, of_robot
from handfast.deploy.inventory import authority_backup
from handfast.deploy.inventory.authority_backup import packed, unpack
from handfast.deploy.inventory.certificate_authority import AuthorityError
from tests.trusted import FLEET, NOW_S, authority, credentials

PASSPHRASE = "correct horse battery staple"
ROBOT = of_robot(FLEET, 2)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(authority_backup, "KDF_ROUNDS", 1000)


@pytest.fixture
def backup(tmp_path: Path) -> bytes:
    """Of the authority in `keys`, which has given robot 2 a certificate, and has been replaced before."""
    with authority(tmp_path / "keys") as by:
        by.replace(NOW_S)
        credentials(by, tmp_path / "robot", ROBOT)
        return packed(tmp_path / "keys", FLEET, PASSPHRASE)


def test_restored_it_is_what_it_was(tmp_path: Path, backup: bytes) -> None:
    with authority(tmp_path / "keys") as by:
        before, pem, issued = by.fingerprint, by.certificate_pem, by.issued()
    assert b"PRIVATE" not in backup
    secret = (tmp_path / "keys" / "authority.pem").read_bytes()
    shutil.rmtree(tmp_path / "keys")
    assert unpack(tmp_path / "keys", FLEET, backup, PASSPHRASE) == before
    with authority(tmp_path / "keys") as again:
        assert (again.fingerprint, again.certificate_pem, again.generation) == (before, pem, 2)
        assert again.issued() == issued
        assert not again.created
        assert wanting(tmp_path / "robot", ROBOT, (), again.certificate_pem, NOW_S) == "", "no re-keying"
        credentials(again, tmp_path / "keys", of_operator(FLEET))
    assert (tmp_path / "keys" / "authority.pem").read_bytes() == secret
    assert (tmp_path / "keys" / "authority.pem").stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "keys").stat().st_mode & 0o777 == 0o700


def test_the_key_is_under_the_passphrase(backup: bytes, tmp_path: Path) -> None:
    body = (tmp_path / "keys" / "authority.pem").read_text().split("-----")[2].replace("\n", "")
    der = base64.b64decode(body)
    sealed = base64.b64decode(json.loads(backup)["pkcs12"])
    assert der[-60:] not in sealed
    with pytest.raises(AuthorityError, match="the passphrase is not that of this backup"):
        unpack(tmp_path / "new", FLEET, backup, "another passphrase")
    assert not (tmp_path / "new").exists()


def changed(backup: bytes, **fields: object) -> bytes:
    return json.dumps(json.loads(backup) | fields).encode()


def test_what_is_no_backup_of_this_fleet(backup: bytes, tmp_path: Path) -> None:
    for data, why in (
        (b"", "it is no backup of an authority"),
        (b"[" * 100_000, "it is no backup"),
        (b"[]", "it is no backup"),
        (changed(backup, index=[]), "it is no backup"),
        (changed(backup, pkcs12=7), "it is no backup"),
        (changed(backup, handfast_authority=2), "it is a backup of version '2', not 1"),
        (changed(backup, fleet="other"), "it is the backup of the authority of 'other', not of guarded"),
        (changed(backup, pkcs12="x"), "the backup is damaged"),
    ):
        with pytest.raises(AuthorityError, match=why):
            unpack(tmp_path / "new", FLEET, data, PASSPHRASE)
    assert not (tmp_path / "new").exists()


def test_nothing_takes_the_place_of_what_is_there(backup: bytes, tmp_path: Path) -> None:
    with pytest.raises(AuthorityError, match=r"has an authority, .*: nothing to restore"):
        unpack(tmp_path / "keys", FLEET, backup, PASSPHRASE)
    with authority(tmp_path / "keys") as by:
        by.replace(NOW_S)
    (tmp_path / "keys" / "authority.pem").unlink()
    with pytest.raises(AuthorityError, match="it was replaced since the backup was made, or elsewhere"):
        unpack(tmp_path / "keys", FLEET, backup, PASSPHRASE)
