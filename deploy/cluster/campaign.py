"""Where a campaign is driven: by processes of this machine or by a Dask cluster."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, TypeVar

from handfast.agent.common.errors import packages_named
from handfast.agent.common.wording import printable
from handfast.deploy.cluster.program import ClusterError, SameProgram
from handfast.deploy.hosts.bundle import files_of_plugins
from handfast.deploy.simulate import worker_pool
from handfast.deploy.simulate.worker_pool import Engine, Work

WORKERS_S: Final = 60.0
"""Default time to wait while a scheduler has no worker."""
_ADDRESS: Final = re.compile(r"(tcp|tls)://[^\s/]+:[0-9]{1,5}")

T = TypeVar("T")


class Resources:
    """Where runs are driven: by processes of this machine, or by a Dask cluster.

    Args:
        cluster: value of ``--cluster``; None for this machine.
        jobs: runs at a time on this machine; None for the number of cores.
        wait_s: time to wait while a cluster has no worker; None for the default.
        timeout_s: real time that a run may take.

    Raises:
        ClusterError: these contradict each other, or `cluster` names no scheduler.
        handfast.agent.common.errors.MissingPackageError: Dask is not installed.
    """

    def __init__(self, cluster: str | None, jobs: int | None, wait_s: float | None, timeout_s: float) -> None:
        if cluster is not None and jobs is not None:
            raise ClusterError(
                "a cluster decides how many runs it drives at a time: leave out --jobs (workers in Python)"
            )
        if jobs is not None and jobs < 1:
            raise ClusterError(f"--jobs must be at least 1, got {jobs}")
        if cluster is None and wait_s is not None:
            raise ClusterError("--cluster-wait (cluster_wait in Python) needs a cluster")
        self.jobs = jobs or worker_pool.cores()
        self._address = None if cluster is None else scheduler_address(cluster)
        self._wait_s, self._timeout_s = WORKERS_S if wait_s is None else wait_s, timeout_s

    def engine(
        self, work: Work[T], program: Mapping[str, str], plugins: tuple[str, ...], say: Callable[[str], None]
    ) -> Engine[T]:
        """Make the engine that drives runs of `work`.

        Args:
            program: `identity` of the program that must drive every run.
            plugins: laws and plants of the runs (`plugins_of`). Their files are sent to a cluster.
            say: shows a line to the user.
        """
        same = SameProgram(work, program, plugins)
        if self._address is None:
            return worker_pool.Pool(same, self.jobs, self._timeout_s)
        from handfast.deploy.cluster.engine import Cluster

        files, lacking = files_of_plugins(plugins)
        for error in lacking:
            say(f"{error}; workers need it installed")
        return Cluster(self._address, same, self._timeout_s, files, self._wait_s)


def scheduler_address(cluster: str) -> str:
    """Return the address of the scheduler that ``--cluster`` names, directly or by its scheduler file.

    Raises:
        ClusterError: it names neither.
        handfast.agent.common.errors.MissingPackageError: Dask is not installed.
    """
    address: object = cluster
    said = f"--cluster {printable(cluster)}"
    if "://" not in cluster and Path(cluster).is_file():
        try:
            address = json.loads(Path(cluster).read_bytes())["address"]
        except (OSError, ValueError, LookupError, TypeError):
            raise ClusterError(f"{said}: the file is not a Dask scheduler file") from None
    if not isinstance(address, str) or not _ADDRESS.fullmatch(address):
        raise ClusterError(
            f"{said}: must be tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, or its scheduler file"
        )
    with packages_named("--cluster"):
        import distributed  # noqa: F401 (to find out before anything is begun)
    return address
