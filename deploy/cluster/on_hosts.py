"""A cluster for one campaign: a scheduler here, and a worker on each host of a fleet, started by ssh.

Hosts need nothing but what `handfast up` needs: what a worker runs is sent along, in a version of its own.
Scheduler and workers trust a certificate that is made for this campaign and ends with it.
"""

from __future__ import annotations

import datetime
import logging
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from math import inf
from types import TracebackType
from typing import Final, Generic, TypeVar

import dask
import distributed

from handfast.agent.common.errors import Error
from handfast.agent.common.wording import printable
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.cluster import worker_on_host
from handfast.deploy.cluster.connection import ClusterError
from handfast.deploy.cluster.engine import Cluster, Say
from handfast.deploy.cluster.reasons import error_line
from handfast.deploy.cluster.worker_process import security
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.console.data_files import WORKER_REQUIREMENTS
from handfast.deploy.hosts.artifacts.bundle import (
    PACKAGES,
    BundleError,
    Platform,
    bundle_for,
    program_archive,
)
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.hosts.jobs import HostJobs
from handfast.deploy.hosts.setup import install
from handfast.deploy.hosts.view import DOING, Row
from handfast.deploy.simulate.worker_pool import GoOn, Work

SENT: Final = (*PACKAGES, "handfast/deploy")
"""Packages of ours that a worker runs."""
LOOK_S: Final = 2.0
"""How often a host is asked whether its worker runs."""
LOST_S: Final = 12.0
"""A host over whose connections nothing comes for so long is lost; Dask takes no less than 11."""
END_S: Final = 3.0
VALID: Final = datetime.timedelta(days=30)
"""So long a campaign may take, and so far a host's clock may be off."""

T = TypeVar("T")


class HostsCluster(Generic[T]):
    """Drives runs of `work` on the hosts of a fleet file. An `Engine`; arguments as of `Cluster`.

    Args:
        fleet: the fleet file, or name of a bundled fleet, that has hosts.
        accept_new: takes the keys of hosts that were never met before for their own.
    """

    def __init__(
        self,
        fleet: str,
        work: Work[T],
        timeout_s: float,
        *,
        files: Mapping[str, bytes],
        say: Say,
        count: Callable[[int, int], None] = lambda _runs, _workers: None,
        go_on: GoOn = lambda: True,
        accept_new: bool = False,
    ) -> None:
        try:
            self._fleet = load_fleet(fleet_path(fleet))
        except Error as error:
            raise ClusterError(f"--cluster ssh:{printable(fleet)}: {error}") from None
        if not self._fleet.hosts:
            raise ClusterError(
                f"--cluster ssh:{fleet}: the fleet has no hosts: write [host.NAME] for each computer"
            )
        self._name, self._work, self._timeout_s = fleet, work, timeout_s
        self._files, self._say, self._count, self._wanted = files, say, count, go_on
        self._accept_new = accept_new
        self._stop = threading.Event()

    def __enter__(self) -> HostsCluster[T]:
        self._program = program_archive(packages=SENT)
        key, certificate = credentials()
        try:
            trust = security(key, certificate)
        except ValueError as error:  # of other settings of Dask's configuration, which hold here, too
            raise ClusterError(f"Dask's configuration cannot be used: {error_line(error)}") from None
        with ExitStack() as stack:
            stack.enter_context(dask.config.set({"distributed.comm.timeouts.tcp": f"{LOST_S:g}s"}))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that this machine has no way to the world outside
                here = distributed.LocalCluster(  # no more than a scheduler
                    n_workers=0, host="0.0.0.0", protocol="tls://", security=trust, dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )  # fmt: skip
            scheduler = stack.enter_context(here)
            self._settings = {"key": key, "certificate": certificate}
            self._port: int = scheduler.scheduler.port
            self._jobs = self._make_jobs()
            stack.enter_context(self._jobs)
            stack.callback(self._end)
            cluster = Cluster(
                f"tls://127.0.0.1:{self._port}", self._work, self._timeout_s, files=self._files,
                say=self._say, count=self._count, security=trust, broken=self._broken,
                expects=self._expected, patience_s=inf, name=f"ssh:{self._name}", go_on=self._wanted,
            )  # fmt: skip
            self._cluster = stack.enter_context(cluster)
            self._left = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.close()

    def results(self, runs: Iterable[int], go_on: GoOn) -> Iterator[T]:
        """As `Cluster.results`."""
        return self._cluster.results(runs, go_on)

    def _make_jobs(self) -> HostJobs:
        """What has every host work."""
        hosts = self._fleet.hosts
        return HostJobs(
            self._fleet, hosts, self._serve, accept_new=self._accept_new, at_once=len(hosts),
            failed=self._failed,
        )  # fmt: skip

    def _end(self) -> None:
        """Has every host end its worker: by its own connection's end, unless that takes too long."""
        self._stop.set()
        until_s = time.monotonic() + END_S
        while self._jobs.busy and time.monotonic() < until_s:
            time.sleep(0.05)

    def _broken(self) -> str | None:
        """Why no host works any more, None while one may."""
        rows = self._jobs.rows.values()
        if any(row.state == DOING for row in rows):
            return None
        why = "; ".join(f"{row.host}: {row.step}" for row in rows)
        return f"no host of {self._name} has a worker: {why}"

    def _expected(self) -> int:
        """How many hosts have a worker, or will have."""
        return sum(row.state == DOING for row in self._jobs.rows.values())

    def _serve(self, connection: HostConnection, row: Row) -> None:
        """Has a host work until the campaign ends."""
        version = self._installed(connection, row)
        connection.extend(worker_on_host)
        connection.ask(
            "start_worker", version=version, port=self._port, settings=self._settings | {"name": row.host}
        )
        while not self._stop.wait(LOOK_S):
            if said := connection.ask("worker_ended"):
                raise HostError(printable(str(said)))

    def _failed(self, row: Row) -> None:
        """Says which host has no worker, or none any more, and why: one that cannot be reached, too."""
        if not self._stop.is_set():
            self._say(f"host {row.host}: {row.step}")

    def _installed(self, connection: HostConnection, row: Row) -> str:
        """The version that a host has installed now, of what a worker runs; the only one that is left of
        earlier ones."""
        last = ""

        def say(text: str) -> None:
            nonlocal last
            row.step = text
            if (what := text.partition(" ")[0]) != last:
                last = what
                self._say(f"host {row.host}: {what}")

        try:
            bundle = bundle_for(Platform.of(connection.about), self._program, WORKER_REQUIREMENTS, SENT)
        except BundleError as error:
            raise HostError(str(error)) from None
        if not connection.ask("installed", version=bundle.version):
            install(connection, bundle, say)
            connection.ask("tidy", keep=[bundle.version])
        return bundle.version


def credentials() -> tuple[str, str]:
    """A key, and a certificate of it that it has signed itself; PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "handfast campaign")])
    now = datetime.datetime.now(tz=datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - VALID)  # a host's clock may be behind
        .not_valid_after(now + VALID)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return private.decode(), certificate.public_bytes(serialization.Encoding.PEM).decode()
