"""A second operator asks for a certificate, and is given one."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.security.credentials import CredentialsError, load
from handfast.agent.security.identity import Identity, of_operator, of_robot
from handfast.deploy.inventory.certificate_authority import Authority
from handfast.deploy.inventory.operator_credentials import (
    SIGNED_BYTES_MAX,
    RequestError,
    install,
    request,
    requested_by,
)
from tests.trusted import FLEET, NOW_S, authority, credentials

ANNA = of_operator(FLEET, "anna")
OPERATORS = ("main", "anna")


def signs(by: Authority, pem: bytes) -> bytes:
    return by.sign(requested_by(pem, FLEET, OPERATORS, "it"), pem, (), NOW_S)


def test_asked_signed_installed(tmp_path: Path) -> None:
    here, there = tmp_path / "main", tmp_path / "anna"
    with authority(here) as by:
        asked = request(there, ANNA)
        assert b"PRIVATE" not in asked
        assert request(there, ANNA) != b"", "it may be asked again, for the same key"
        found = install(there, signs(by, asked), FLEET, OPERATORS, NOW_S)
        assert found.identity == ANNA
        assert found.authority_fingerprint == by.fingerprint
    assert load(there, ANNA, NOW_S).certificate == found.certificate
    assert {path.stat().st_mode & 0o077 for path in there.glob("*.key")} == {0}
    assert not (there / "authority.pem").exists()


def test_where_the_authority_is_nobody_need_be_asked(tmp_path: Path) -> None:
    authority(tmp_path).close()
    with pytest.raises(RequestError, match=r"is in .*: it signs without a request"):
        request(tmp_path, ANNA)


@pytest.mark.parametrize(
    ("whose", "why"),
    [
        (of_operator("other", "anna"), "it is one for the fleet other, not for guarded"),
        (of_operator(FLEET, "eve"), "the operator eve; network.operators of guarded are main, anna"),
        (of_robot(FLEET, 2), "it is one for robot 2, not for an operator"),
    ],
)
def test_a_request_that_is_not_signed(tmp_path: Path, whose: Identity, why: str) -> None:
    with pytest.raises(RequestError, match=why):
        requested_by(request(tmp_path, whose), FLEET, OPERATORS, "it")


def test_a_certificate_that_is_not_installed(tmp_path: Path) -> None:
    there, other = tmp_path / "anna", tmp_path / "other"
    with authority(tmp_path / "main") as by, authority(tmp_path / "eve") as strange:
        answer = signs(by, request(other, ANNA))
        with pytest.raises(CredentialsError, match=r"no request was made from .*: --request makes one"):
            install(there, answer, FLEET, OPERATORS, NOW_S)
        asked = request(there, ANNA)
        with pytest.raises(CredentialsError, match=r"cannot read .*anna.key|is not for its key"):
            install(there, answer, FLEET, OPERATORS, NOW_S)
        good = install(there, signs(by, asked), FLEET, OPERATORS, NOW_S)
        with pytest.raises(CredentialsError, match="the certificate for operator anna is not for its key"):
            install(there, answer, FLEET, OPERATORS, NOW_S)
        with pytest.raises(CredentialsError, match="is not signed by this fleet's authority"):
            install(
                there,
                signs(by, asked).replace(by.certificate_pem, strange.certificate_pem),
                FLEET,
                OPERATORS,
                NOW_S,
            )
        for bundle, why in (
            (b"", "it has 0 certificates, not two"),
            (by.certificate_pem * 60, f"it has over {SIGNED_BYTES_MAX} bytes"),
            (
                by.sign(of_robot(FLEET, 1), request(tmp_path / "r", of_robot(FLEET, 1)), (), NOW_S),
                "for robot 1",
            ),
        ):
            with pytest.raises(RequestError, match=why):
                install(there, bundle, FLEET, OPERATORS, NOW_S)
        with pytest.raises(RequestError, match=r"is one for the operator anna; network.operators"):
            install(there, signs(by, asked), FLEET, ("main",), NOW_S)
    assert load(there, ANNA, NOW_S).certificate == good.certificate


def test_who_has_made_a_second_authority_is_told_to_put_it_away(tmp_path: Path) -> None:
    there = tmp_path / "anna"
    with authority(tmp_path / "main") as by:
        asked = request(there, ANNA)
        answer = signs(by, asked)
        with authority(tmp_path / "second") as second:
            pass
        (there / "authority.pem").write_bytes((tmp_path / "second" / "authority.pem").read_bytes())
        (there / "authority.pem").chmod(0o600)
        (there / "ca.crt").write_bytes(second.certificate_pem)
        with pytest.raises(RequestError, match=r"has another one itself, .*: put .*authority.pem away first"):
            install(there, answer, FLEET, OPERATORS, NOW_S)
        (there / "authority.pem").unlink()
        assert install(there, answer, FLEET, OPERATORS, NOW_S).authority_fingerprint == by.fingerprint


def test_credentials_of_the_main_operator_stay(tmp_path: Path) -> None:
    with authority(tmp_path) as by:
        before = credentials(by, tmp_path, of_operator(FLEET))
        credentials(by, tmp_path, ANNA)
    assert load(tmp_path, of_operator(FLEET), NOW_S).certificate == before.certificate
