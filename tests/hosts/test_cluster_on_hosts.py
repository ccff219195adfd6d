"""`handfast sweep --cluster ssh:FLEET`: workers on test hosts; one is cut off, another one's is killed, a
third host cannot be logged into."""

from __future__ import annotations

import csv
import os
import signal
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import tomli_w

from handfast.deploy.console.data_files import FLEETS, WORKER_REQUIREMENTS
from tests.hosts.fleet_on_hosts import fetch_wheels
from tests.hosts.host import Host
from tests.hosts.hosts import Hosts
from tests.process.harness import ROOT, wait_for

pytestmark = pytest.mark.long

SWEEP = ("pair", "--duration", "8s", "--over", "control.kp=0.5,1", "--repeat", "7", "--random-starts")
WORKER = "handfast.deploy.cluster.worker_process"
TIMEOUT_S = 120.0


def workers(host: Host) -> list[int]:
    """Processes of a worker on a host: that of Dask's nanny, its worker, and those that drive runs."""
    return [pid for pid, words in host.pids().items() if WORKER in words or "spawn_main" in words]


def rows(folder: Path) -> list[dict[str, str]]:
    """Rows of a sweep's folder without the time that they took."""
    found = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    for row in found:
        del row["wall_s"]
    return found


@pytest.mark.timeout(400)
def test_hosts_that_are_lost_cost_nothing_but_time(
    make_hosts: Callable[[int], Hosts], cache: Path, tmp_path: Path
) -> None:
    hosts = make_hosts(2)
    fetch_wheels(hosts[0], cache, WORKER_REQUIREMENTS)
    tables = tomllib.loads((FLEETS / "pair.toml").read_text(encoding="utf-8"))
    tables["host"] = {host.name: {"address": host.address} for host in hosts}
    tables["host"]["elsewhere"] = {"address": "127.0.0.1", "port": 1}
    (tmp_path / "fleet.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    words = [sys.executable, "-P", "-m", "handfast.deploy.cli", "sweep", *SWEEP]
    environment = {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(cache)}

    with open(tmp_path / "out", "w") as out, open(tmp_path / "err", "w") as err:
        command = hosts.operator.popen(
            [*words, "--cluster", "ssh:fleet.toml", "--out", "cluster"],
            environment, cwd=tmp_path, stdout=out, stderr=err,
        )  # fmt: skip

    def told() -> str:
        return (tmp_path / "err").read_text()

    def kept(count: int) -> bool:
        assert command.poll() is None, told()
        results = tmp_path / "cluster" / "results.csv"
        return results.exists() and results.read_bytes().count(b"\n") > count

    try:
        wait_for(lambda: kept(2) and all(workers(host) for host in hosts), "rows, two workers", 200.0, told)
        assert "host elsewhere: it is there, but no ssh server answers on that port" in told(), told()
        hosts[1].cut()
        for pid in workers(hosts[0]):
            if "spawn_main" in hosts[0].pids().get(pid, ""):
                os.kill(pid, signal.SIGKILL)
        assert command.wait(TIMEOUT_S) == 0, told()
    finally:
        command.kill()
        command.wait()
    assert "Traceback" not in told(), told()
    assert "is gone; " in told(), told()
    wait_for(lambda: not workers(hosts[0]), "no worker is left", 20.0, lambda: str(hosts[0].pids()))

    local = hosts.operator.run([*words, "--out", "local"], environment, cwd=tmp_path, timeout=TIMEOUT_S)
    assert local.returncode == 0, local.stderr
    assert rows(tmp_path / "cluster") == rows(tmp_path / "local")
    for file in sorted((tmp_path / "local").iterdir()):
        if file.name != "results.csv":
            assert (tmp_path / "cluster" / file.name).read_bytes() == file.read_bytes(), file.name

    hosts[1].restore()
    wait_for(lambda: not workers(hosts[1]), "nor on the host that was cut off", 60.0)
