"""What makes two installations the same."""

from __future__ import annotations

from deploy.cluster.identity import LIBRARIES, SOURCES, differences, identity
from deploy.console.data_files import ROOT
from deploy.console.sources import sources_digest


def test_it_names_all_that_decides_the_bytes_of_a_run() -> None:
    found = identity()
    assert set(found) == {"Python", "handfast", *LIBRARIES, SOURCES}
    assert found[SOURCES] == sources_digest(ROOT)
    assert all(found.values())


def test_differences_are_said_one_by_one() -> None:
    here = {"Python": "3.11", "numpy": "2.4.6", SOURCES: "aa"}
    assert differences(here, dict(here)) == ""
    assert differences(here, {"Python": "3.12", SOURCES: "bb"}) == (
        "it has Python 3.12, here is 3.11; it has numpy none, here is 2.4.6; "
        "its sources of handfast are others (bb, here aa)"
    )
