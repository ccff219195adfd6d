"""Where a campaign is driven: the engine that ``--cluster`` names, the cores of this machine without it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, Protocol, TypeVar

from agent.common.errors import Error, packages_named
from agent.common.wording import printable
from agent.fleet.model import Fleet
from deploy.hosts.artifacts.plugin_files import PluginFilesError, plugin_files
from deploy.simulate import worker_pool
from deploy.simulate.worker_pool import Engine, Work

SSH: Final = "ssh:"
_SCHEMES: Final = ("tcp://", "tls://")

T = TypeVar("T")


class Progress(Protocol):
    """Shows a campaign's progress, see `deploy.console.progress`."""

    def say(self, text: str) -> None: ...

    def at_work(self, text: str) -> None: ...


class ClusterOptionError(Error):
    """``--cluster`` names no cluster; the text is one line."""


def make_engine(
    cluster: str | None,
    work: Work[T],
    jobs: int,
    timeout_s: float,
    show: Progress,
    fleets: Iterable[Fleet] = (),
) -> Engine[T]:
    """What drives runs of `work`, each in at most `timeout_s`.

    Args:
        cluster: as ``--cluster`` has it; None: this machine, `jobs` runs at a time.
        show: what is shown meanwhile.
        fleets: whose plugins go along to other machines.

    Raises:
        Error: there is no such cluster.
        agent.common.errors.MissingPackageError: what a cluster needs is not installed.
    """
    if cluster is None:
        return worker_pool.Pool(work, jobs, timeout_s)
    check_cluster(cluster)
    from deploy.cluster.engine import Cluster
    from deploy.cluster.on_hosts import HostsCluster

    files = _files(fleets, show)

    def count(number: int) -> None:
        show.at_work(f"{number} at a time")

    if cluster.startswith(SSH):
        name = cluster.removeprefix(SSH)
        return HostsCluster(name, work, timeout_s, files=files, say=show.say, count=count)
    return Cluster(_address(cluster), work, timeout_s, files=files, say=show.say, count=count)


def check_cluster(cluster: str | None) -> None:
    """Refuses what cannot be a cluster, before anything is begun; raises as `make_engine`."""
    if cluster is None:
        return
    if not cluster.startswith(SSH):
        _address(cluster)
    with packages_named("--cluster"):
        import deploy.cluster.engine  # noqa: F401 (whether it can be)


def _address(cluster: str) -> str | Mapping[str, str]:
    """Where the scheduler is, as `deploy.cluster.engine.Cluster` takes it."""
    scheme = next((scheme for scheme in _SCHEMES if cluster.startswith(scheme)), None)
    host, colon, port = cluster.removeprefix(scheme or "").rpartition(":")
    if scheme is not None and host and colon and port.isdecimal():
        return cluster
    if scheme is None and Path(cluster).is_file():
        return {"scheduler_file": cluster}
    raise ClusterOptionError(
        f"--cluster {printable(cluster)}: must be tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, "
        "the file that it was given as --scheduler-file, or ssh:FLEET for a fleet's hosts"
    )


def _files(fleets: Iterable[Fleet], show: Progress) -> dict[str, bytes]:
    """The files of the plugins that fleets name, by their names below a folder of packages."""
    references: set[str] = set()
    for fleet in fleets:
        references |= {robot.plant for robot in fleet.robots if robot.kind.is_plugin}
        references |= {fleet.control.law} if fleet.control.law is not None else set()
    files: dict[str, bytes] = {}
    # A name without a module is known in this process alone: such classes are in the work itself.
    for module in sorted({each.partition(":")[0] for each in references if ":" in each}):
        try:
            files |= dict(plugin_files((module,)))
        except PluginFilesError as error:
            show.say(f"{error}; workers need it installed")
    return files
