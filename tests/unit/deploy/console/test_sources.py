"""Which Python files make a program another one."""

from __future__ import annotations

from pathlib import Path

from handfast.deploy.console.sources import PACKAGES, sources_digest


def tree(folder: Path) -> Path:
    for package in PACKAGES:
        (folder / package).mkdir(parents=True)
        (folder / package / "module.py").write_text("x = 1\n")
    (folder / "handfast" / "__init__.py").write_text("")
    return folder


def test_a_byte_of_a_source_and_its_name_count_and_nothing_else_does(tmp_path: Path) -> None:
    root = tree(tmp_path)
    before = sources_digest(root)
    (root / "handfast" / "agent" / "module.pyc").write_bytes(b"compiled")
    (root / "tests.py").write_text("")
    assert sources_digest(root) == before
    (root / "handfast" / "agent" / "module.py").rename(root / "handfast" / "agent" / "other.py")
    renamed = sources_digest(root)
    (root / "handfast" / "deploy" / "module.py").write_text("x = 2\n")
    assert len({before, renamed, sources_digest(root)}) == 3


def test_plugins_count_whatever_their_order(tmp_path: Path) -> None:
    root = tree(tmp_path)
    one = sources_digest(root, {"law.py": b"1", "plant.py": b"2"})
    assert one == sources_digest(root, {"plant.py": b"2", "law.py": b"1"})
    assert len({one, sources_digest(root), sources_digest(root, {"law.py": b"2", "plant.py": b"2"})}) == 3
    assert sources_digest(root, {}) == sources_digest(root)
