"""Test hosts as a fixture."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.hosts.host import Setup
from tests.hosts.hosts import Hosts, missing


@pytest.fixture(scope="session")
def can_have_hosts() -> None:
    """Skips the test where no hosts can be made; .ci/run lets that count as a failure."""
    if (reason := missing()) is not None:
        pytest.skip(reason)


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The operator's folder for what it keeps, of wheels above all: one for all tests."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def make_hosts(can_have_hosts: None) -> Iterator[Callable[[int | Sequence[Setup]], Hosts]]:
    """Makes sets of test hosts that last until the module's last test."""
    with contextlib.ExitStack() as stack:
        yield lambda hosts: stack.enter_context(Hosts(hosts))
