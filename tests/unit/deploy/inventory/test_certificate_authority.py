"""The fleet's certificate authority: whom it signs for, and what it keeps."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from handfast.agent.security.certificates import pem_of_key
from handfast.agent.security.credentials import CredentialsError, load, make_request, store
from handfast.agent.security.identity import of_operator, of_robot, of_router
from handfast.deploy.inventory import certificate_authority as module
from handfast.deploy.inventory.certificate_authority import (
    AUTHORITY_DAYS,
    CERTIFICATE_DAYS,
    Authority,
    AuthorityError,
)
from handfast.deploy.inventory.operator_credentials import KEYS, OPERATOR, keys_folder, operator_name
from tests.trusted import FLEET, NOW_S, ROBOTS, authority, credentials

DAY_S = 86_400
ME = of_robot(FLEET, 2)


def test_it_is_made_once(tmp_path: Path) -> None:
    with authority(tmp_path / "a" / "b") as first:
        assert first.created
        name = first.fingerprint
        assert first.days_left(NOW_S) == AUTHORITY_DAYS
    with authority(tmp_path / "a" / "b") as again:
        assert not again.created
        assert (again.fingerprint, again.generation) == (name, 1)
    assert (tmp_path / "a" / "b").stat().st_mode & 0o777 == 0o700
    for file in ("authority.pem", "index.json"):
        path = tmp_path / "a" / "b" / file
        assert not path.exists() or path.stat().st_mode & 0o777 == 0o600


def test_the_index_says_what_was_signed(tmp_path: Path) -> None:
    with authority(tmp_path) as by:
        robot = credentials(by, tmp_path / "r", ME, ("10.0.0.2", "r2.lan"))
        credentials(by, tmp_path, of_operator(FLEET))
    with authority(tmp_path) as by:
        first, second = by.issued()
    assert (first.identity, second.identity) == (f"{FLEET}.robot.2", f"{FLEET}.operator.main")
    assert first.fingerprint == robot.certificate.fingerprint
    assert (
        first.addresses
        == robot.certificate.addresses
        == ("10.0.0.2", "127.0.0.1", "::1", "localhost", "r2.lan")
    )
    assert first.days_left(NOW_S) == CERTIFICATE_DAYS


def test_whom_it_does_not_sign_for(tmp_path: Path) -> None:
    with authority(tmp_path / "a") as by:
        request = make_request(tmp_path / "r", ME)
        for identity, asked, what in (
            (of_robot(FLEET, 9), make_request(tmp_path / "r", of_robot(FLEET, 9)), "no robot 9 in guarded"),
            (of_robot("other", 2), make_request(tmp_path / "r", of_robot("other", 2)), "not of the fleet"),
            (of_robot(FLEET, 1), request, r"request of robot 1 is one for 'guarded\.robot\.2'"),
            (of_operator(FLEET), request, "request of operator main is one for"),
            (of_router(FLEET), request, "request of router main is one for"),
            (ME, b"", "not a certificate request"),
            (ME, os.urandom(300), "not a certificate request"),
            (ME, bytes(10_000), "too large"),
            (ME, by.certificate_pem, "not a certificate request"),
        ):
            with pytest.raises(AuthorityError, match=what):
                by.sign(identity, asked, (), NOW_S)
        with pytest.raises(AuthorityError, match="neither an IP address nor a host name"):
            by.sign(ME, request, ["a b"], NOW_S)
        assert by.issued() == ()


def test_requests_that_were_tampered_with(tmp_path: Path) -> None:
    import base64

    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    def request(key: ec.EllipticCurvePrivateKey, *names: str) -> bytes:
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text) for text in names])
        made = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
        return made.public_bytes(serialization.Encoding.PEM)

    key = ec.generate_private_key(ec.SECP256R1())
    genuine = request(key, ME.common_name)
    der = bytearray(base64.b64decode(b"".join(genuine.splitlines()[1:-1])))
    der[-1] ^= 1
    damaged = b"-----BEGIN CERTIFICATE REQUEST-----\n%s\n-----END CERTIFICATE REQUEST-----\n" % (
        base64.b64encode(bytes(der))
    )
    with authority(tmp_path) as by:
        assert by.sign(ME, genuine, (), NOW_S)
        for asked in (
            damaged,
            request(key, ME.common_name, f"{FLEET}.operator.main"),
            request(ec.generate_private_key(ec.SECP384R1()), ME.common_name),
        ):
            with pytest.raises(AuthorityError):
                by.sign(ME, asked, (), NOW_S)


def test_nothing_of_a_request_is_taken_over_but_the_key(tmp_path: Path) -> None:
    """A robot that asks to be an authority, or for another's address, gets neither."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    asked = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, ME.common_name)]))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("base.lan")]), critical=False)
        .sign(key, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )
    with authority(tmp_path) as by:
        signed = x509.load_pem_x509_certificate(by.sign(ME, asked, ["10.0.0.2"], NOW_S))
    assert not signed.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    names = signed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["localhost"]


def test_a_new_authority_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    with authority(tmp_path / "a") as by:
        before = credentials(by, tmp_path / "r", ME)
    with authority(tmp_path / "a", new=True) as by:
        assert (by.generation, by.created) == (2, True)
        assert by.fingerprint != before.authority_fingerprint
        after = credentials(by, tmp_path / "r", ME)
        assert after.authority_fingerprint == by.fingerprint
        assert [entry.generation for entry in by.issued()] == [1, 2]
    with authority(tmp_path / "a") as again:
        assert (again.generation, again.fingerprint) == (2, after.authority_fingerprint)
    (tmp_path / "a" / "authority.pem").unlink()
    with pytest.raises(AuthorityError, match=f"of the authority {again.fingerprint[:16]}, which is not here"):
        authority(tmp_path / "a")
    with authority(tmp_path / "a", new=True) as third:  # a name is never used twice
        assert (third.generation, third.created) == (3, True)


def test_it_knows_whether_a_robot_has_a_certificate_of_it(tmp_path: Path) -> None:
    with authority(tmp_path / "a") as by:
        by.sign(of_operator(FLEET), make_request(tmp_path / "o", of_operator(FLEET)), (), NOW_S)
        assert not by.has_robots
        credentials(by, tmp_path / "r", ME)
    with authority(tmp_path / "a", new=True) as again:
        assert again.has_robots


def test_where_a_request_waits_none_is_made(tmp_path: Path) -> None:
    make_request(tmp_path, of_operator(FLEET, "anna"))
    with pytest.raises(AuthorityError, match=r"a request from .* waits to be signed by the fleet's"):
        authority(tmp_path)


def test_a_certificate_ends_with_its_authority(tmp_path: Path) -> None:
    authority(tmp_path).close()
    late_s = NOW_S + (AUTHORITY_DAYS - 100) * DAY_S
    with authority(tmp_path, late_s) as by:
        found = credentials(by, tmp_path / "r", ME, now_s=late_s)
        assert found.certificate.days_left(late_s) == 100
    end_s = NOW_S + AUTHORITY_DAYS * DAY_S
    with authority(tmp_path, end_s) as by:  # it can still be looked at
        request = make_request(tmp_path / "r", ME)
        with pytest.raises(AuthorityError, match="has expired: `handfast keys guarded --new-authority`"):
            by.sign(ME, request, (), end_s)
    with authority(tmp_path, end_s, new=True) as by:
        by.sign(ME, request, (), end_s)


@pytest.mark.parametrize(
    ("file", "damage", "what"),
    [
        ("authority.pem", b"", "authority.pem: it is not a private key"),
        ("authority.pem", pem_of_key, "authority.pem: it is not a certificate"),
        ("index.json", b"{", "index.json is damaged"),
        ("index.json", b'{"version": 2, "issued": []}', "index.json is damaged"),
        ("index.json", b'{"version": 1, "issued": [{"identity": "x"}]}', "index.json is damaged"),
    ],
)
def test_files_that_are_damaged(tmp_path: Path, file: str, damage: object, what: str) -> None:
    from handfast.agent.security.certificates import new_key

    authority(tmp_path).close()
    path = tmp_path / file
    path.touch(0o600)
    path.write_bytes(damage(new_key()) if callable(damage) else damage)  # type: ignore[arg-type]
    for _ in range(2):  # and the lock is let go
        with pytest.raises(AuthorityError, match=what):
            authority(tmp_path)


def test_keys_that_others_can_read(tmp_path: Path) -> None:
    authority(tmp_path / "a").close()
    (tmp_path / "a" / "authority.pem").chmod(0o644)
    with pytest.raises(AuthorityError, match=r"others may read the private key .*: chmod 600"):
        authority(tmp_path / "a")
    (tmp_path / "a" / "authority.pem").chmod(0o600)
    (tmp_path / "a").chmod(0o750)
    with pytest.raises(AuthorityError, match="chmod 700"):
        authority(tmp_path / "a")


def test_another_fleets_folder(tmp_path: Path) -> None:
    authority(tmp_path).close()
    with pytest.raises(AuthorityError, match=r"the authority 'guarded\.authority\.1', not one of other"):
        authority(tmp_path, fleet="other")


def test_one_command_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with authority(tmp_path):
        monkeypatch.setattr(module, "WAIT_S", 0.0)
        with pytest.raises(AuthorityError, match="another handfast command uses the keys of guarded"):
            authority(tmp_path)
    authority(tmp_path).close()


def test_threads_share_it(tmp_path: Path) -> None:
    with Authority(tmp_path, FLEET, ROBOTS, NOW_S) as by:
        requests = [make_request(tmp_path / str(robot), of_robot(FLEET, robot)) for robot in ROBOTS]

        def ask(robot: int) -> None:
            by.sign(of_robot(FLEET, robot), requests[robot - 1], (), NOW_S)

        threads = [threading.Thread(target=ask, args=(robot,)) for robot in ROBOTS for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with authority(tmp_path) as by:
        assert len({entry.serial for entry in by.issued()}) == 12


def test_closed(tmp_path: Path) -> None:
    by = authority(tmp_path)
    request = make_request(tmp_path / "r", ME)
    by.close()
    by.close()
    with pytest.raises(AuthorityError, match="closed"):
        by.sign(ME, request, (), NOW_S)


def test_the_environment_says_where_keys_are_and_who_gives_orders(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv(KEYS, raising=False)
    monkeypatch.delenv(OPERATOR, raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert (keys_folder("delta"), operator_name()) == (tmp_path / "handfast/keys/delta", "main")
    monkeypatch.setenv("XDG_CONFIG_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert keys_folder("delta") == tmp_path / "home" / ".config" / "handfast" / "keys" / "delta"
    monkeypatch.setenv(KEYS, str(tmp_path / "mine"))
    monkeypatch.setenv(OPERATOR, "anna")
    assert (keys_folder("delta"), operator_name()) == (tmp_path / "mine", "anna")


def test_a_power_cut_between_files(tmp_path: Path) -> None:
    """`ca.crt` is but a copy of what is in the authority's own file."""
    with authority(tmp_path) as by:
        credentials(by, tmp_path, of_operator(FLEET))
        old = (tmp_path / "ca.crt").read_bytes()
    authority(tmp_path, new=True).close()
    (tmp_path / "ca.crt").write_bytes(old)
    load(tmp_path, of_operator(FLEET), NOW_S)
    with authority(tmp_path) as by:
        assert (tmp_path / "ca.crt").read_bytes() == by.certificate_pem
        with pytest.raises(CredentialsError, match="not signed by this fleet's authority of now"):
            load(tmp_path, of_operator(FLEET), NOW_S)
        store(
            tmp_path,
            of_operator(FLEET),
            by.sign(of_operator(FLEET), make_request(tmp_path, of_operator(FLEET)), (), NOW_S),
            NOW_S,
        )
