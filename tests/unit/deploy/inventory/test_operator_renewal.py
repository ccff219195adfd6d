"""An operator's certificate that has expired is renewed where the authority is."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.credentials import CredentialsError
from handfast.agent.security.identity import of_operator
from handfast.deploy.inventory.certificate_builder import CERTIFICATE_DAYS
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE
from handfast.deploy.inventory.operator_renewal import usable
from tests.process.guarded import guarded_fleet
from tests.trusted import FLEET, authority, credentials

LONG_AGO_S = time.time() - (CERTIFICATE_DAYS + 3) * DAY_S
MAIN = of_operator(FLEET)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With the authority, and a certificate of the main operator that has expired."""
    with authority(tmp_path / "keys", LONG_AGO_S) as by:
        credentials(by, tmp_path / "keys", MAIN, now_s=LONG_AGO_S)
    return tmp_path / "keys"


def test_it_is_renewed_on_the_spot(folder: Path) -> None:
    found = usable(guarded_fleet(), folder, MAIN)
    assert usable(guarded_fleet(), folder, MAIN).certificate.der == found.certificate.der


def test_elsewhere_it_is_said_that_it_has_expired(folder: Path) -> None:
    (folder / AUTHORITY_FILE).unlink()
    with pytest.raises(CredentialsError, match="expired"):
        usable(guarded_fleet(), folder, MAIN)


def test_one_that_is_valid_stays_as_it_is(tmp_path: Path) -> None:
    with authority(tmp_path / "keys", time.time()) as by:
        made = credentials(by, tmp_path / "keys", MAIN, now_s=time.time())
    assert usable(guarded_fleet(), tmp_path / "keys", MAIN).certificate.der == made.certificate.der
