"""Schedulers that say nothing, ports that are no scheduler, clusters that have no worker yet."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.deploy.cluster import engine
from handfast.deploy.cluster.connection import CONNECT_S
from handfast.deploy.cluster.engine import Cluster
from handfast.deploy.simulate.worker_pool import EngineLost
from tests.process import adaptive_cluster
from tests.process.dask_processes import DaskProcesses
from tests.process.harness import ADDRESS, Command, environment, no_trouble, wait_for
from tests.process.killing_work import KillingWork
from tests.process.test_cluster import STATUS_S, wait_for_rows

# Dask leaves sockets of dead peers open.
pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::ResourceWarning")]
SWEEP = ("pair", "--duration", "1s", "--out", "out")
SOON_S = 12.0
"""An end that somebody asked for takes no longer than this, on any busy machine."""


@pytest.fixture
def mute() -> Iterator[str]:
    """Where connections are taken, and nothing is ever said."""
    with socket.create_server((ADDRESS, 0)) as server:
        yield f"tcp://{ADDRESS}:{server.getsockname()[1]}"


def test_a_port_that_is_no_scheduler_is_one_line(mute: str, tmp_path: Path) -> None:
    with Command(tmp_path, "sweep", *SWEEP, "--cluster", mute) as command:
        assert command.wait(STATUS_S) == 2, command.told()
    said = f"handfast: there is no scheduler at {mute}: what listens there has not answered as one within"
    assert f"{said} {CONNECT_S:.0f} s" in command.err
    no_trouble(command.err, "the command")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_waiting_for_an_answer_ends_when_told(mute: str, tmp_path: Path, number: signal.Signals) -> None:
    with Command(tmp_path, "sweep", *SWEEP, "--cluster", mute) as command:
        wait_for(lambda: f"on {mute}" in command.err, "its beginning", STATUS_S, command.told)
        os.kill(command.process.pid, number)
        begun_s = time.monotonic()
        assert command.wait(STATUS_S) == 130, command.told()
        assert time.monotonic() - begun_s < CONNECT_S - 2.0
    assert "0 of 1 run is done and kept; go on with" in command.err
    no_trouble(command.err, "the command")


def test_a_scheduler_that_stands_still_is_noticed_and_ctrl_c_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with DaskProcesses(tmp_path / "dask", 1) as dask:
        assert dask.scheduler is not None
        with Command(tmp_path, "sweep", *SWEEP, "--repeat", "2000", "--cluster", dask.address) as command:
            wait_for_rows(command, tmp_path / "out", 1)
            os.kill(dask.scheduler.pid, signal.SIGSTOP)
            time.sleep(2.0)  # what it has said before is taken meanwhile
            os.killpg(command.process.pid, signal.SIGINT)
            begun_s = time.monotonic()
            assert command.wait(STATUS_S) == 130, command.told()
            assert time.monotonic() - begun_s < SOON_S
        no_trouble(command.err, "the command")
        os.kill(dask.scheduler.pid, signal.SIGCONT)

        monkeypatch.setattr(engine, "SILENT_S", 3.0)
        with Cluster(dask.address, KillingWork(), 9.0, files={}, say=print) as cluster:
            wait_for(lambda: cluster._watch.usable(), "the worker", STATUS_S, dask.told)
            assert list(cluster.results([2], lambda: True)) == ["done 2"]
            os.kill(dask.scheduler.pid, signal.SIGSTOP)
            with pytest.raises(EngineLost, match="is gone"):
                list(cluster.results(range(3, 50), lambda: True))
            begun_s = time.monotonic()
        assert time.monotonic() - begun_s < SOON_S
        os.kill(dask.scheduler.pid, signal.SIGCONT)


def test_a_cluster_that_grows_by_its_work_is_used(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, adaptive_cluster.__file__],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment(), text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            address = process.stdout.readline().strip()
            with Command(tmp_path, "sweep", *SWEEP, "--repeat", "3", "--cluster", address) as command:
                assert command.wait(STATUS_S) == 0, command.told()
            no_trouble(command.err, "the command")
            assert re.search(r"^3 of 3 runs, .* 1 at a time on 1 worker\b", command.err, re.MULTILINE)
        finally:
            assert process.stdin is not None
            process.stdin.close()


def test_waiting_for_a_worker_is_said_and_ends_when_told(tmp_path: Path) -> None:
    with DaskProcesses(tmp_path / "dask", 0) as dask:
        arguments = (*SWEEP, "--cluster", dask.address, "--cluster-wait")
        with Command(tmp_path, "sweep", *arguments, "1s") as command:
            assert command.wait(STATUS_S) == 2, command.told()
        assert "none has come within 1 s (--cluster-wait, or " in command.err
        with Command(tmp_path, "sweep", *arguments, "10min") as command:
            says = re.compile(r"no worker at tcp://\S+ yet: waiting for one since 2\d s, for 600 s at most")
            wait_for(lambda: says.search(command.err), "what it waits for", STATUS_S, command.told)
            os.killpg(command.process.pid, signal.SIGINT)
            begun_s = time.monotonic()
            assert command.wait(STATUS_S) == 130, command.told()
            assert time.monotonic() - begun_s < SOON_S
        no_trouble(command.err, "the command")
