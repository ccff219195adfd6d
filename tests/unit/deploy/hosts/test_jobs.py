"""Work on several hosts at a time: what is under way can be ended."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.hosts.connection import HostConnection
from handfast.deploy.hosts.jobs import DONE, HostJobs
from tests.process.harness import wait_for
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, fleet


def test_a_host_that_does_not_answer_yet_is_reached_by_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ssh").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "ssh").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    connecting = threading.Event()

    class Connection(HostConnection):
        def __enter__(self) -> HostConnection:
            connecting.set()
            return super().__enter__()

    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", Connection)
    there = fleet(HOSTS, LEFT, LEFT)
    begun = time.monotonic()
    with HostJobs(there, there.hosts[:1], lambda *_: pytest.fail("it answered")) as jobs:
        assert connecting.wait(10.0)
        jobs.end()
    assert time.monotonic() - begun < 15.0, "it would be waited for for 20 s"
    assert [row.step for row in jobs.rows.values()] == ["interrupted"]


def test_hosts_that_do_not_answer_hold_up_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of some hundred, half are switched off."""
    dead = threading.Event()

    class Connection:
        def __init__(self, host: HostSection, *_: object, **__: object) -> None:
            self.host = host

        def __enter__(self) -> Connection:
            if self.host.name.startswith("off"):
                dead.wait(300.0)
            return self

        def __exit__(self, *_: object) -> None: ...

        def abort(self) -> None:
            dead.set()

    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostConnection", Connection)
    hosts = [HostSection(f"{state}{k}", "a") for state in ("off", "on") for k in range(50)]
    with HostJobs(fleet(HOSTS, LEFT, LEFT), hosts, lambda *_: None) as jobs:
        answered = [row for name, row in jobs.rows.items() if name.startswith("on")]
        wait_for(lambda: all(row.state == DONE for row in answered), "those that are on have answered")
        assert jobs.busy
