"""Work on several hosts at a time: what is under way can be ended."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from deploy.hosts.connection import HostConnection
from deploy.hosts.jobs import HostJobs
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

    monkeypatch.setattr("deploy.hosts.jobs.HostConnection", Connection)
    there = fleet(HOSTS, LEFT, LEFT)
    begun = time.monotonic()
    with HostJobs(there, there.hosts[:1], lambda *_: pytest.fail("it answered")) as jobs:
        assert connecting.wait(10.0)
        jobs.end()
    assert time.monotonic() - begun < 15.0, "it would be waited for for 20 s"
    assert [row.step for row in jobs.rows.values()] == ["interrupted"]
