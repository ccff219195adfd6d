"""The folder in which a user's runs find each other."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from handfast.agent.runtime.order_store import NotPrivateError, private_folder


def test_the_folder_is_made_for_this_user_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = private_folder()
    assert folder == private_folder() == tmp_path / f"handfast-{os.getuid()}"
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_may_write_to_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = private_folder()
    folder.chmod(0o777)
    with pytest.raises(NotPrivateError, match="nobody else may write to"):
        private_folder()


def test_a_link_to_elsewhere_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / f"handfast-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(NotPrivateError):
        private_folder()


def test_what_is_no_folder_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    place = tmp_path / f"handfast-{os.getuid()}"
    place.write_text("")
    with pytest.raises(NotPrivateError, match="remove it"):
        private_folder()
    place.unlink()
    place.symlink_to(tmp_path / "nowhere")
    with pytest.raises(NotPrivateError, match="remove it"):
        private_folder()
