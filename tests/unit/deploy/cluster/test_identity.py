"""What makes two installations the same."""

from __future__ import annotations

import pytest

from handfast.agent.common.errors import MissingPackageError
from handfast.deploy.cluster import identity as module
from handfast.deploy.cluster.identity import (
    CHANGED,
    LIBRARIES,
    NEEDED,
    NONE,
    SOURCES,
    THERE,
    differences,
    identity,
    refuse_lacking,
)
from handfast.deploy.console.data_files import ROOT
from handfast.deploy.console.sources import sources_digest


def test_it_names_all_that_decides_the_bytes_of_a_run() -> None:
    found = identity()
    assert set(found) == {"Python", "handfast", *LIBRARIES, *NEEDED, SOURCES}
    assert found[SOURCES] == sources_digest(ROOT)
    assert all(found.values())
    assert NONE not in found.values()


def test_differences_are_said_one_by_one_with_what_to_do() -> None:
    here = {"Python": "3.11", "handfast": "0.1", "numpy": "2.4.6", SOURCES: "aa"}
    assert differences(here, dict(here)) == ""
    assert differences(here, {"Python": "3.12", "handfast": "0.2", "numpy": "2.3.0", SOURCES: "bb"}) == (
        "it has Python 3.12, here is 3.11: start it with Python 3.11; "
        "it has handfast 0.2, here is 0.1: install the same there; "
        "it has numpy 2.3.0, here is 2.4.6: pip install numpy==2.4.6 there, or numpy==2.3.0 here; "
        "its sources of handfast are others (bb, here aa): install the same there and start it again"
    )
    assert differences({SOURCES: "aa"}, {SOURCES: CHANGED}) == (
        "its sources of handfast are others (changed since it started, here aa): start it again"
    )


def test_a_package_that_a_worker_lacks_is_named_with_how_to_install_it() -> None:
    here = {"numpy": "2.4.6", "pymap3d": "3.2.0", "orjson": THERE}
    assert differences(here, here | {"pymap3d": NONE}) == (
        "it lacks the package pymap3d: pip install 'handfast[cluster]'"
    )
    assert differences(here, here | {"pymap3d": NONE, "orjson": NONE}) == (
        "it lacks the packages pymap3d, orjson: pip install 'handfast[cluster]'"
    )
    assert differences(here, {"numpy": "2.4.6", "orjson": THERE}) == (
        "it lacks the package pymap3d: pip install 'handfast[cluster]'"
    )
    assert differences(here | {SOURCES: "aa"}, {SOURCES: "bb"}) == (
        "its sources of handfast are others (bb, here aa): install the same there and start it again"
    ), "of what a worker of other sources does not speak nothing is known"


@pytest.mark.parametrize("name", ["pymap3d", "orjson"])
def test_what_is_lacking_here_is_said_before_any_worker_is_asked(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse_lacking()
    found, installed = module.find_spec, module._version
    monkeypatch.setattr(module, "find_spec", lambda each: None if each == name else found(each))
    monkeypatch.setattr(module, "_version", lambda each: NONE if each == name else installed(each))
    with pytest.raises(MissingPackageError) as raised:
        refuse_lacking()
    assert str(raised.value) == f"--cluster needs the package {name}: pip install 'handfast[cluster]'"
