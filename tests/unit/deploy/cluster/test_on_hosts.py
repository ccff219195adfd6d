"""A cluster of a fleet's hosts, as far as it goes without hosts."""

from __future__ import annotations

import queue
import ssl
import threading
from pathlib import Path
from types import SimpleNamespace

import dask
import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.cluster.on_hosts import HostsCluster, credentials
from handfast.deploy.cluster.watch import ClusterError
from handfast.deploy.cluster.worker_process import security
from handfast.deploy.console.data_files import FLEETS, WORKER_REQUIREMENTS
from handfast.deploy.hosts.artifacts.bundle import PACKAGES, program_archive
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.view import Row
from tests.unit.deploy.cluster.test_sent import Doubles


def cluster(fleet: str) -> HostsCluster[int]:
    return HostsCluster(fleet, Doubles(), 9.0, files={}, say=print)


def test_a_fleet_without_hosts_is_refused() -> None:
    with pytest.raises(ClusterError, match=r"the fleet has no hosts: write \[host.NAME\]"):
        cluster("pair")


def test_why_no_host_works_is_said_when_none_does(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text((FLEETS / "pair.toml").read_text() + '\n[host.a]\naddress = "192.0.2.1"\n[host.b]\n')
    found = cluster(str(file))
    rows = {name: Row(name, ()) for name in ("a", "b")}
    found._jobs = SimpleNamespace(rows=rows)  # type: ignore[assignment]
    rows["a"].fail("it does not answer")
    assert found._broken() is None
    assert found._expected() == 1
    rows["b"].fail("the disk is full")
    assert found._broken() == (f"no host of {file} has a worker: a: it does not answer; b: the disk is full")


def test_a_setting_of_dask_that_is_wrong_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text((FLEETS / "pair.toml").read_text() + "\n[host.a]\n")
    with (
        dask.config.set({"distributed.comm.tls.min-version": 9}),
        pytest.raises(ClusterError, match=r"^Dask's configuration cannot be used: .*min-version=9 is not"),
        cluster(str(file)),
    ):
        raise AssertionError


@pytest.mark.parametrize("accept_new", [False, True])
def test_a_host_that_cannot_be_logged_into_is_named_at_once_while_others_work(
    accept_new: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text((FLEETS / "pair.toml").read_text() + "\n[host.a]\n[host.b]\n")
    ended = threading.Event()
    told: queue.SimpleQueue[str] = queue.SimpleQueue()

    class Connection:
        def __init__(self, host: HostSection, _robots: int, *, accept_new: bool) -> None:
            self.host, self._accepts = host, accept_new

        def __enter__(self) -> Connection:
            if self.host.name == "b":
                raise HostError("it does not let you in")
            assert self._accepts is accept_new
            assert ended.wait(30.0)
            raise HostError("what comes of the end")

        def __exit__(self, *_: object) -> None: ...

        def abort(self) -> None:
            ended.set()

    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", Connection)
    found = HostsCluster(str(file), Doubles(), 9.0, files={}, say=told.put, accept_new=accept_new)
    found._jobs = found._make_jobs()
    with found._jobs as jobs:
        assert told.get(timeout=10.0) == "host b: it does not let you in"
        assert found._broken() is None
    assert jobs.rows["a"].step == "interrupted"
    assert told.empty(), "of what is ended nothing is said"


def test_who_has_the_certificate_is_trusted(tmp_path: Path) -> None:
    key, certificate = credentials()
    trust = security(key, certificate)
    for role in ("client", "scheduler", "worker"):
        assert isinstance(trust.get_connection_args(role)["ssl_context"], ssl.SSLContext)
        assert trust.get_connection_args(role)["require_encryption"]
    other = credentials()
    assert other != (key, certificate)


def test_what_is_sent_has_the_operators_package_and_its_wheels_have_dask() -> None:
    assert b"deploy/cluster/worker_process.py" in program_archive(packages=(*PACKAGES, "deploy"))
    assert b"deploy/cluster" not in program_archive()
    assert "\ndistributed==" in WORKER_REQUIREMENTS.read_text()
