"""Where a campaign is driven: the engine that ``--cluster`` names, the cores of this machine without it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Protocol, TypeVar

from handfast.agent.common.errors import Error, packages_named
from handfast.agent.common.wording import printable
from handfast.agent.common.wording import show as shown
from handfast.agent.fleet.model import Fleet
from handfast.deploy.cluster.reasons import error_line
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.hosts.artifacts.plugin_files import files_of_plugins
from handfast.deploy.simulate import worker_pool
from handfast.deploy.simulate.worker_pool import Engine, GoOn, Work

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
    *,
    go_on: GoOn = lambda: True,
    wait_s: float | None = None,
    accept_new: bool = False,
) -> Engine[T]:
    """What drives runs of `work`, each in at most `timeout_s`.

    Args:
        cluster: as ``--cluster`` has it; None: this machine, `jobs` runs at a time.
        show: what is shown meanwhile.
        fleets: whose plugins go along to other machines.
        go_on: is asked while a cluster is looked for: where it says no, no run is driven.
        wait_s: how long a cluster without a worker is waited for; else as long as it is.
        accept_new: takes the keys of a fleet's hosts that were never met before for their own.

    Raises:
        Error: there is no such cluster.
        handfast.agent.common.errors.MissingPackageError: what a cluster needs is not installed.
    """
    if cluster is None:
        return worker_pool.Pool(work, jobs, timeout_s)
    check_cluster(cluster)
    from handfast.deploy.cluster.engine import WORKERS_S, Cluster
    from handfast.deploy.cluster.on_hosts import HostsCluster

    files = _files(fleets, show)

    def count(runs: int, workers: int) -> None:
        show.at_work(f"{runs} at a time on {workers} worker{'s' * (workers != 1)}")

    if cluster.startswith(SSH):
        name = cluster.removeprefix(SSH)
        return HostsCluster(
            name, work, timeout_s, files=files, say=show.say, count=count, go_on=go_on, accept_new=accept_new
        )
    address = _address(cluster)
    return Cluster(
        address, work, timeout_s, files=files, say=show.say, count=count, go_on=go_on,
        patience_s=WORKERS_S if wait_s is None else wait_s,
        name=address if address == cluster else f"{address} ({printable(cluster)})",
    )  # fmt: skip


def check_cluster(cluster: str | None) -> None:
    """Refuses what cannot be a cluster, before anything is begun; raises as `make_engine`."""
    if cluster is None:
        return
    if not cluster.startswith(SSH):
        _address(cluster)
    elif not (fleet := cluster.removeprefix(SSH)):
        raise ClusterOptionError(f"--cluster {SSH} names no fleet: write {SSH}FLEET, a fleet file with hosts")
    else:
        try:
            fleet_path(fleet)
        except Error as error:
            raise ClusterOptionError(f"--cluster {printable(cluster)}: {error}") from None
    with packages_named("--cluster"):
        try:
            import handfast.deploy.cluster.engine  # noqa: F401 (whether it can be)
        except ImportError:
            raise
        except Exception as error:  # of its configuration, which Dask reads when it is imported
            why = error_line(error)
            raise ClusterOptionError(f"Dask cannot be loaded with its configuration: {why}") from None
    from handfast.deploy.cluster.identity import refuse_lacking

    refuse_lacking()


def _address(cluster: str) -> str:
    """Where the scheduler is, as `deploy.cluster.engine.Cluster` takes it."""
    if _is_address(cluster):
        return cluster
    if not cluster.startswith(_SCHEMES) and Path(cluster).is_file():
        return _address_in(Path(cluster))
    raise ClusterOptionError(
        f"--cluster {printable(cluster)}: must be tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler, "
        "the file that it was given as --scheduler-file, or ssh:FLEET for a fleet's hosts"
    )


def _address_in(path: Path) -> str:
    """The address in the file that a scheduler has written."""
    said = f"--cluster {printable(str(path))}"
    must = 'must be what a Dask scheduler writes for --scheduler-file, {"address": "tcp://HOST:PORT", ...}'
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise ClusterOptionError(f"{said}: cannot read the file: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        raise ClusterOptionError(f"{said}: {must}, and is no JSON") from None
    address = found.get("address") if isinstance(found, dict) else None
    if not isinstance(address, str):
        raise ClusterOptionError(f"{said}: {must}, and has no address")
    if not _is_address(address):
        raise ClusterOptionError(f"{said}: {must}, and its address is {shown(address)}")
    return address


def _is_address(text: str) -> bool:
    """Whether it is the address of a scheduler."""
    scheme = next((scheme for scheme in _SCHEMES if text.startswith(scheme)), None)
    host, colon, port = text.removeprefix(scheme or "").rpartition(":")
    # Not `isdecimal`: digits of other scripts are, too.
    return bool(scheme and host and colon and re.fullmatch("[0-9]{1,5}", port) and 0 < int(port) < 65536)


def _files(fleets: Iterable[Fleet], show: Progress) -> dict[str, bytes]:
    """The files of the plugins that fleets name; of whom there are none is said. Classes that are known in
    this process alone are in the work itself."""
    files, lacking = files_of_plugins(fleets)
    for error in lacking:
        show.say(f"{error}; workers need it installed")
    return files
