"""Where an operator's credentials are, and those of authorities that were replaced."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.security.credentials import authority_of, load
from handfast.agent.security.identity import of_operator, of_router
from handfast.deploy.inventory.operator_credentials import (
    KEYS,
    OPERATOR,
    drop_earlier,
    earlier_folders,
    former_certificates,
    keep_as_earlier,
    keys_folder,
    operator_name,
    short,
)
from tests.trusted import FLEET, NOW_S, authority, credentials

ME = of_operator(FLEET)


def test_the_environment_says_where_and_who(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(KEYS, raising=False)
    monkeypatch.delenv(OPERATOR, raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert (keys_folder("delta"), operator_name()) == (tmp_path / "handfast/keys/delta", "main")
    monkeypatch.setenv(KEYS, str(tmp_path / "mine"))
    monkeypatch.setenv(OPERATOR, "anna")
    assert (keys_folder("delta"), operator_name()) == (tmp_path / "mine", "anna")


def test_what_was_in_use_is_kept_when_the_authority_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    with authority(folder) as by:
        before = credentials(by, folder, ME)
        credentials(by, folder, of_router(FLEET))
        assert earlier_folders(folder) == []
        by.replace(NOW_S)
        assert authority_of(folder) == by.fingerprint
        after = credentials(by, folder, ME)
    (kept,) = earlier_folders(folder)
    assert kept.name == short(before.authority_fingerprint)
    assert load(kept, ME, NOW_S).certificate == before.certificate
    assert load(kept, of_router(FLEET), NOW_S).authority_fingerprint == before.authority_fingerprint
    assert load(folder, ME, NOW_S).certificate == after.certificate
    assert {path.stat().st_mode & 0o777 for path in (kept, kept.parent)} == {0o700}
    assert {path.stat().st_mode & 0o077 for path in kept.glob("*.key")} == {0}
    assert (kept / "authority.pem").stat().st_mode & 0o777 == 0o600
    drop_earlier(folder)
    assert earlier_folders(folder) == []
    drop_earlier(folder)
    (former,) = former_certificates(folder)  # for good: of what was sealed under it there are recordings
    assert former.name == f"{short(before.authority_fingerprint)}.crt"


def test_each_that_was_replaced_is_kept(tmp_path: Path) -> None:
    with authority(tmp_path) as by:
        for _ in range(3):
            credentials(by, tmp_path, ME)
            by.replace(NOW_S)
    assert len(earlier_folders(tmp_path)) == 3


def test_a_copy_that_was_interrupted_is_none(tmp_path: Path) -> None:
    with authority(tmp_path) as by:
        credentials(by, tmp_path, ME)
        cut = tmp_path / "earlier" / f".{short(by.fingerprint)}.new"
        cut.mkdir(parents=True, mode=0o700)
        (tmp_path / "earlier").chmod(0o700)
        (cut / "ca.crt").write_text("half")
        assert earlier_folders(tmp_path) == []
        keep_as_earlier(tmp_path)
        assert earlier_folders(tmp_path) == [], "what is in use is not an earlier one"
        by.replace(NOW_S)
    (kept,) = earlier_folders(tmp_path)
    assert load(kept, ME, NOW_S)


def test_without_an_authority_there_is_nothing_to_keep(tmp_path: Path) -> None:
    keep_as_earlier(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "ca.crt").write_text("no certificate")
    assert authority_of(tmp_path) == ""
