"""The base of errors, and what is said of packages that are not installed."""

from __future__ import annotations

import pytest

from handfast.agent.common.errors import Error, MissingPackageError, packages_named


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("matplotlib.figure", "the package matplotlib.figure: install the operator's extra, pip install 'ha"),
        ("serial", "the package serial: install the rovers' extra, pip install 'handfast[rover]'"),
        ("handfast.deploy", "the package handfast.deploy: install the operator's extra"),
    ],
)
def test_a_package_that_is_missing_is_named_with_its_extra(name: str, says: str) -> None:
    with (
        pytest.raises(MissingPackageError, match=r"^handfast\.run needs ") as caught,
        packages_named("handfast.run"),
    ):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    assert says in str(caught.value)
    assert isinstance(caught.value, Error)


@pytest.mark.parametrize("name", ["handfast.agent.cores", "handfast.deploy.apis", None])
def test_a_fault_of_our_own_stays_what_it_is(name: str | None) -> None:
    with pytest.raises(ModuleNotFoundError), packages_named():
        raise ModuleNotFoundError("no", name=name)
