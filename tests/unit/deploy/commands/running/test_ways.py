"""Which ways there are to stop a fleet from here."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.runtime import order_store
from handfast.agent.security.private_files import private_directory
from handfast.deploy.commands.running.ways import by_ssh, ways
from handfast.deploy.processes.placement import orders_folder
from handfast.deploy.session.stop import Way
from tests.unit.deploy.inventory.test_own_orders import HOSTS
from tests.unit.deploy.orders.order_fleets import square


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="hf") as folder:
        monkeypatch.setattr(order_store.tempfile, "gettempdir", lambda: folder)
        yield


def names(made: list[Way]) -> list[str]:
    for way in made:
        way.close()
    return [type(way).__name__ for way in made]


def test_a_run_here_has_a_file_and_one_elsewhere_has_ssh() -> None:
    here, elsewhere = square(), parse_fleet(HOSTS, source="here")
    assert names(ways(here)) == []
    private_directory(orders_folder(here))
    assert names(ways(here)) == ["FileWay"]
    assert names(ways(elsewhere)) == ["SshWay"]
    assert by_ssh(here) == []
