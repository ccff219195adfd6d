"""One run of a sweep, and where runs are driven: by this machine or by a Dask cluster.

A run is driven in virtual time and leaves one row. Of its messages only those are kept that its metrics need.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

from handfast.agent.common.errors import packages_named
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.deploy.console.sources import files_of_plugins
from handfast.deploy.console.wording import error_text
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.simulate import worker_pool
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.simulate.worker_pool import Abandoned, ClusterError, Engine, GoOn, SameProgram, Work
from handfast.deploy.sweep.plan import Plan
from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.run_result import RunResult


def drive(fleet: Fleet, go_on: GoOn = lambda: True) -> Recording:
    """Drives `fleet` (resolved) for its duration. What went wrong in the operator's eyes is in `reasons`.

    Raises:
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    name = fleet.fleet.name
    data = RunData(fleet, mode="simulate")
    # Hand states, beacons and what agents did to them are most of the messages, and nobody is judged by them.
    wanted = {
        key_expressions.mission(name),
        key_expressions.stop(name),
        key_expressions.resume(name),
        key_expressions.events(name),
    }
    for robot in fleet.ids:
        wanted |= {
            key_expressions.plant_state(name, robot),
            key_expressions.plant_truth(name, robot),
            key_expressions.plant_links(name, robot),
            key_expressions.wrench(name, robot),
            key_expressions.status(name, robot),
            key_expressions.relayed(name, robot),
        }

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        if key in wanted:
            data.feed(received_ns, key, simulation.decode(payload))

    def progress(_: float) -> bool:
        if not go_on():
            raise Abandoned
        return True

    simulation = Simulation(fleet, sink)
    simulation.run(progress)
    return data.recording(reasons=simulation.reasons)


PASSED: Final = "passed"
FAILED: Final = "failed"
CRASHED: Final = "crashed"
TIMED_OUT: Final = "timed out"
VERDICTS: Final = (PASSED, FAILED, CRASHED, TIMED_OUT)


@dataclass(frozen=True, slots=True)
class Row:
    """The result of one run.

    Attributes:
        run: its number in the plan.
        seed: its `fleet.seed`.
        verdict: `PASSED`, `FAILED` (it was driven, and something was wrong), `CRASHED` or `TIMED_OUT` (it
            was not driven to the end: there are no numbers).
        reason: the first of the verdict's reasons, one line, empty when it passed.
        safe: the oracle `separation` found nothing: no two robots came below the safe distance; None when
            not known.
        settled: every edge was within 5 % of its distance at the end, and every robot at its place, or soon
            there (`deploy.verdict.tracking`); None when not known.
        numbers: by the names of `deploy.verdict.metrics.columns`, those that are known.
        wall_s: real time that it took.
    """

    run: int
    seed: int
    verdict: str
    reason: str
    safe: bool | None = None
    settled: bool | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    wall_s: float = 0.0

    @property
    def good(self) -> bool:
        """Safe and settled."""
        return self.safe is True and self.settled is True


@dataclass(frozen=True, slots=True)
class Runs:
    """The runs of a plan, as `deploy.simulate.worker_pool.Pool` drives them."""

    plan: Plan

    def execute(self, number: int, go_on: Callable[[], bool]) -> Row:
        return execute(self.plan, number, go_on)

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> Row:
        return unfinished(self.plan, number, TIMED_OUT if timed_out else CRASHED, reason, wall_s)


def execute(plan: Plan, run: int, go_on: Callable[[], bool] = lambda: True) -> Row:
    """Drives one run; whatever goes wrong in it becomes its row.

    Raises:
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    begun = time.perf_counter()
    try:
        fleet = plan.fleet(run)
        result = RunResult(drive(fleet, go_on))
        numbers = {name: metric.value(result) for name, (metric, _) in metrics.columns().items()}
        separation = result.violations["separation"]
        return Row(
            run,
            plan.run_seed(run),
            PASSED if result.passed else FAILED,
            next(iter(result.reasons), ""),
            not separation,  # None: one robot has nobody to come near
            result.analysis.settling_s is not None and not result.tracking.reasons,
            {name: float(value) for name, value in numbers.items() if value is not None},
            time.perf_counter() - begun,
        )
    except Abandoned:
        raise
    except (Exception, KeyboardInterrupt) as error:  # a Ctrl-C is not sent here: a plugin has raised it
        return unfinished(plan, run, CRASHED, error_text(error), time.perf_counter() - begun)


def unfinished(plan: Plan, run: int, verdict: str, reason: str, wall_s: float) -> Row:
    """The row of a run that was not driven to its end."""
    return Row(run, plan.run_seed(run), verdict, reason, wall_s=wall_s)


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
        from handfast.deploy.sweep.cluster import Cluster

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
