"""What makes two installations the same."""

from __future__ import annotations

from pathlib import Path

from deploy.cluster.identity import LIBRARIES, PACKAGES, SOURCES, differences, identity, sources_digest
from deploy.console.data_files import ROOT


def tree(folder: Path) -> Path:
    for package in PACKAGES:
        (folder / package).mkdir(parents=True)
        (folder / package / "module.py").write_text("x = 1\n")
    (folder / "handfast.py").write_text("")
    return folder


def test_it_names_all_that_decides_the_bytes_of_a_run() -> None:
    found = identity()
    assert set(found) == {"Python", "handfast", *LIBRARIES, SOURCES}
    assert found[SOURCES] == sources_digest(ROOT)
    assert all(found.values())


def test_a_byte_of_a_source_and_its_name_count_and_nothing_else_does(tmp_path: Path) -> None:
    root = tree(tmp_path)
    before = sources_digest(root)
    (root / "agent" / "module.pyc").write_bytes(b"compiled")
    (root / "tests.py").write_text("")
    assert sources_digest(root) == before
    (root / "agent" / "module.py").rename(root / "agent" / "other.py")
    renamed = sources_digest(root)
    (root / "deploy" / "module.py").write_text("x = 2\n")
    assert len({before, renamed, sources_digest(root)}) == 3


def test_differences_are_said_one_by_one() -> None:
    here = {"Python": "3.11", "numpy": "2.4.6", SOURCES: "aa"}
    assert differences(here, dict(here)) == ""
    assert differences(here, {"Python": "3.12", SOURCES: "bb"}) == (
        "it has Python 3.12, here is 3.11; it has numpy none, here is 2.4.6; "
        "its sources of handfast are others (bb, here aa)"
    )
