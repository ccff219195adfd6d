"""Keys and certificates of one identity: how they come, and what is not trusted."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.agent.security import __main__
from handfast.agent.security.certificates import CertificateError, authority_from_pem, issued, key_from_pem
from handfast.agent.security.credentials import (
    CredentialsError,
    Files,
    MissingError,
    NotValidNowError,
    load,
    make_request,
    store,
    wanting,
)
from handfast.agent.security.identity import of_operator, of_robot
from handfast.agent.security.private_files import home_folder
from handfast.deploy.inventory.certificate_authority import AUTHORITY_DAYS, CERTIFICATE_DAYS, Authority
from tests.trusted import FLEET, NOW_S, authority, credentials

DAY_S = 86_400
ME = of_robot(FLEET, 2)


@pytest.fixture
def signed(tmp_path: Path) -> tuple[Authority, Path]:
    """An authority, and the folder of robot 2 with its credentials."""
    by = authority(tmp_path / "authority")
    folder = tmp_path / "robot"
    credentials(by, folder, ME, ("10.0.0.2",))
    return by, folder


def test_credentials_are_for_this_user_only(signed: tuple[Authority, Path]) -> None:
    _, folder = signed
    assert folder.stat().st_mode & 0o777 == 0o700
    assert Files(folder, ME).key.stat().st_mode & 0o777 == 0o600
    assert not Files(folder, ME).next_key.exists()


def test_what_they_say(signed: tuple[Authority, Path]) -> None:
    by, folder = signed
    found = load(folder, ME, NOW_S)
    assert found.identity == ME
    assert found.authority_fingerprint == by.fingerprint
    assert found.certificate.addresses == ("10.0.0.2", "127.0.0.1", "::1", "localhost")
    assert found.certificate.days_left(NOW_S) == CERTIFICATE_DAYS
    assert repr(found.key) not in repr(found)


def test_only_what_is_missing_is_asked_for(signed: tuple[Authority, Path]) -> None:
    by, folder = signed
    pem = by.certificate_pem
    assert wanting(folder, ME, ("10.0.0.2",), pem, NOW_S) == ""
    assert wanting(folder, ME, (), None, NOW_S) == ""
    assert wanting(folder, ME, ("10.0.0.3",), pem, NOW_S) == "it does not hold for 10.0.0.3"
    assert wanting(folder, of_robot(FLEET, 1), (), pem, NOW_S) == "it has none yet"
    later = NOW_S + (CERTIFICATE_DAYS - 30) * DAY_S
    assert wanting(folder, ME, (), pem, later - 1) == ""
    assert wanting(folder, ME, (), pem, later) == "it expires in 30 days"
    assert wanting(folder, ME, (), pem, later + 30 * DAY_S) == "it has expired"
    assert "clock" in wanting(folder, ME, (), pem, NOW_S - DAY_S)
    by.close()
    with authority(by.folder, new=True) as other:
        assert wanting(folder, ME, (), other.certificate_pem, NOW_S) == "the authority is another one now"


def test_the_key_in_use_stays_until_the_certificate_comes(signed: tuple[Authority, Path]) -> None:
    by, folder = signed
    before = load(folder, ME, NOW_S)
    request = make_request(folder, ME)
    assert load(folder, ME, NOW_S).certificate == before.certificate
    again = make_request(folder, ME)  # an answer to either will do: both are for the same key
    store(folder, ME, by.sign(ME, request, (), NOW_S), NOW_S)
    after = load(folder, ME, NOW_S)
    assert after.certificate.public_key != before.certificate.public_key
    store(folder, ME, by.sign(ME, again, (), NOW_S), NOW_S)
    assert load(folder, ME, NOW_S).certificate.public_key == after.certificate.public_key


def test_a_waiting_key_that_is_damaged_is_made_again(signed: tuple[Authority, Path]) -> None:
    by, folder = signed
    make_request(folder, ME)
    Files(folder, ME).next_key.write_bytes(b"")
    store(folder, ME, by.sign(ME, make_request(folder, ME), (), NOW_S), NOW_S)


@pytest.mark.parametrize("which", ["authority", "certificate", "key"])
def test_a_file_that_is_missing_or_damaged_is_named(signed: tuple[Authority, Path], which: str) -> None:
    _, folder = signed
    path: Path = getattr(Files(folder, ME), which)
    for damage in (b"", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", os.urandom(500)):
        path.write_bytes(damage)
        with pytest.raises(CredentialsError, match=path.name) as raised:
            load(folder, ME, NOW_S)
        assert len(str(raised.value).splitlines()) == 1
        assert "cannot be used" in wanting(folder, ME, (), None, NOW_S)
    path.unlink()
    with pytest.raises(CredentialsError, match=f"{path.name}: no such file"):
        load(folder, ME, NOW_S)
    assert wanting(folder, ME, (), None, NOW_S) == "it has none yet"


def test_files_that_others_can_read_or_change(signed: tuple[Authority, Path]) -> None:
    _, folder = signed
    files = Files(folder, ME)
    files.key.chmod(0o640)
    with pytest.raises(CredentialsError, match=r"others may read the private key .*: chmod 600"):
        load(folder, ME, NOW_S)
    with pytest.raises(CredentialsError, match="chmod 600"):
        wanting(folder, ME, (), None, NOW_S)
    files.key.chmod(0o600)
    files.authority.chmod(0o666)
    with pytest.raises(CredentialsError, match=r"others may change .*ca\.crt"):
        load(folder, ME, NOW_S)
    files.authority.chmod(0o644)
    folder.chmod(0o755)
    with pytest.raises(CredentialsError, match="chmod 700"):
        make_request(folder, ME)


def test_a_full_disk_leaves_what_was_there(
    signed: tuple[Authority, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever of the files it is that there is no room for."""
    by, folder = signed
    before = load(folder, ME, NOW_S)
    bundle = by.sign(ME, make_request(folder, ME), (), NOW_S)
    genuine = os.fsync
    for room in range(2):
        left = iter(range(room))

        def fsync(handle: int, left: Iterator[int] = left) -> None:
            if next(left, None) is None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            genuine(handle)

        with monkeypatch.context() as full:
            full.setattr(os, "fsync", fsync)
            with pytest.raises(CredentialsError, match=r"cannot write .*: no space left on device"):
                store(folder, ME, bundle, NOW_S)
        assert load(folder, ME, NOW_S).certificate == before.certificate
    assert store(folder, ME, bundle, NOW_S).certificate != before.certificate
    assert not list(folder.glob("*.next.*"))


def test_a_folder_that_cannot_be_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = Path.stat

    def refuse(path: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if path.parent != tmp_path:
            return genuine(path, follow_symlinks=follow_symlinks)
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "stat", refuse)
    key = Files(tmp_path, ME).key
    with pytest.raises(CredentialsError, match=f"cannot look for {key}: permission denied"):
        wanting(tmp_path, ME, (), None, NOW_S)
    with pytest.raises(CredentialsError, match=r"cannot look for .*: permission denied") as raised:
        load(tmp_path, ME, NOW_S)
    assert len(str(raised.value).splitlines()) == 1


def test_what_is_missing_is_told_from_what_is_wrong(signed: tuple[Authority, Path]) -> None:
    _, folder = signed
    files = Files(folder, ME)
    files.key.chmod(0o640)
    with pytest.raises(CredentialsError) as wrong:
        load(folder, ME, NOW_S)
    assert type(wrong.value) is CredentialsError
    files.certificate.unlink()
    with pytest.raises(MissingError):
        load(folder, ME, NOW_S)


def test_a_certificate_that_ends_with_its_authority_is_not_renewed_again_and_again(tmp_path: Path) -> None:
    end_s = NOW_S + AUTHORITY_DAYS * DAY_S
    with authority(tmp_path / "authority") as by:
        credentials(by, tmp_path / "robot", ME, now_s=end_s - 200 * DAY_S)
        pem = by.certificate_pem
    assert wanting(tmp_path / "robot", ME, (), pem, end_s - 5 * DAY_S) == ""
    assert wanting(tmp_path / "robot", ME, (), pem, end_s) == "it has expired"


def test_times(signed: tuple[Authority, Path]) -> None:
    _, folder = signed
    load(folder, ME, NOW_S - 300)  # a robot's clock may be a little behind
    with pytest.raises(NotValidNowError, match="not valid yet: is this machine's clock right"):
        load(folder, ME, NOW_S - 3600)
    with pytest.raises(CredentialsError, match="expired 2 days ago"):
        load(folder, ME, NOW_S + (CERTIFICATE_DAYS + 2) * DAY_S)


def test_answers_that_are_not_right(signed: tuple[Authority, Path], tmp_path: Path) -> None:
    by, folder = signed
    before = {path: path.read_bytes() for path in folder.iterdir()}
    other = authority(tmp_path / "other")
    mine = by.sign(ME, make_request(folder, ME), (), NOW_S)
    operator = of_operator(FLEET)
    his = by.sign(operator, make_request(tmp_path / "his", operator), (), NOW_S)
    stranger = tmp_path / "stranger"
    not_my_key = by.sign(ME, make_request(stranger, ME), (), NOW_S)
    mixed = mine.partition(b"-----END CERTIFICATE-----\n")[0] + b"-----END CERTIFICATE-----\n"
    for bundle, what in (
        (b"", "0 certificates came"),
        (mixed, "1 certificates came"),
        (mine + mine, "4 certificates came"),
        (mixed + other.certificate_pem, "not signed by this fleet's authority"),
        (mixed + mixed, "not the certificate of an authority"),
        (his, f"one of {operator.common_name}"),
        (not_my_key, "is not for its key"),
    ):
        with pytest.raises(CredentialsError, match=what):
            store(folder, ME, bundle, NOW_S)
    with pytest.raises(CredentialsError, match="expired"):
        store(folder, ME, mine, NOW_S + 400 * DAY_S)
    assert {path: path.read_bytes() for path in before} == before


def test_a_robots_certificate_signs_no_others(signed: tuple[Authority, Path], tmp_path: Path) -> None:
    """Whoever has a robot's key cannot make certificates with it, whatever they write in them."""
    _, folder = signed
    mine = load(folder, ME, NOW_S)
    with pytest.raises(CertificateError, match="not the certificate of an authority"):
        authority_from_pem(mine.files.certificate.read_bytes())
    with pytest.raises(CertificateError) as raised:
        issued(credentials(authority(tmp_path / "x"), tmp_path / "y", ME).certificate.der, mine.authority)
    assert raised.value.reason == "unknown_authority"


def test_a_key_of_another_kind() -> None:
    from cryptography.hazmat.primitives.asymmetric import ec

    from handfast.agent.security.certificates import pem_of_key

    with pytest.raises(CertificateError, match="P-256"):
        key_from_pem(pem_of_key(ec.generate_private_key(ec.SECP384R1())))


class Standard:
    """Standard input of bytes."""

    def __init__(self, data: bytes) -> None:
        self.buffer = self
        self.read = lambda _most: data


def test_the_robots_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import time

    now_s = time.time()
    by = authority(tmp_path / "authority", now_s)
    folder = tmp_path / "robot"

    def run(command: str, *arguments: str, stdin: bytes = b"") -> tuple[int, str, str]:
        monkeypatch.setattr("sys.stdin", Standard(stdin))
        status = __main__.main(
            [command, "--folder", str(folder), "--fleet", FLEET, "--robot", "2", *arguments]
        )
        said = capsys.readouterr()
        return status, said.out, said.err

    asks = ("request", "--addresses", "10.0.0.2,r2.lan", "--ca", "-")
    status, out, err = run(*asks, stdin=by.certificate_pem)
    told = json.loads(out)
    assert (status, err, told["wanting"]) == (0, "", "it has none yet")
    assert "PRIVATE" not in out
    bundle = by.sign(ME, told["request"].encode(), ["10.0.0.2", "r2.lan"], now_s)
    status, out, err = run("store", stdin=bundle)
    assert (status, err, json.loads(out)["wanting"]) == (0, "", "")
    status, out, err = run(*asks, stdin=by.certificate_pem)
    told = json.loads(out)
    wanted = {"identity": ME.common_name, "wanting": "", "authority": by.fingerprint}
    assert (status, told) == (0, wanted)
    assert run("store", stdin=b"x")[::2] == (
        2,
        "robot 2: 0 certificates came, not two: its own and the authority's\n",
    )
    assert run(*asks, stdin=b"x")[::2] == (2, "the authority's certificate: it is not a certificate\n")
    assert run("store", stdin=b"x" * 40_000)[0] == 2
    assert run("request", "--addresses", "a b")[::2] == (
        2,
        "'a b' is neither an IP address nor a host name\n",
    )
    status, _, err = run("request", "--ca", str(tmp_path / "nothing"))
    assert (status, err) == (2, f"cannot read {tmp_path / 'nothing'}: no such file or directory\n")


def test_a_user_without_a_home_has_a_folder_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    assert not home_folder().exists()
