"""A run, whole and in memory: columns of numbers, metrics, tables and pictures."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from handfast.agent.common.errors import Error, packages_named
from handfast.agent.formation.points import Floats
from handfast.deploy.api.values import Known, a_path, flags, in_words_of_python
from handfast.deploy.inventory.own_orders import refuse_full
from handfast.deploy.recording.tables import Table

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from handfast.deploy.api.fleet import Fleet
    from handfast.deploy.recording.recording import Recording as Data
    from handfast.deploy.recording.recording import RobotData
    from handfast.deploy.report.export import Columns
    from handfast.deploy.verdict.run_result import RunResult

_SHOWN: Final = (
    "settling_time_s", "min_distance_m.edge", "min_distance_m.any", "final_distance_error_m",
    "final_tracking_error_m", "rms_distance_error_m", "age_of_information_ms.p99",
)  # fmt: skip
"""Metrics in a notebook."""


class Poses(NamedTuple):
    """Where a body was, n times: t (s), x, y (m), heading (rad, counter-clockwise from x), speed
    (m/s), yaw_rate (rad/s); all (n,). The truth, where its plant measures with noise."""

    t: Floats
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    yaw_rate: Floats


class Hands(NamedTuple):
    """What a robot told its neighbours, n times: t (n,) s; of its hand point position (m) and velocity (m/s),
    and the forces per unit mass (m/s²) of the law: navigation, constraint, and correction (what the safety
    filter changed); all (n, 2), in W."""

    t: Floats
    position: Floats
    velocity: Floats
    navigation: Floats
    constraint: Floats
    correction: Floats


class Wrenches(NamedTuple):
    """What a robot asked of its body, n times: t (s), force (N), torque (N m), brake (1.0: it was to brake);
    all (n,)."""

    t: Floats
    force: Floats
    torque: Floats
    brake: Floats


class States(NamedTuple):
    """The states of a robot one after the other: t (n,) s at which each began, n states, n reasons."""

    t: Floats
    state: tuple[str, ...]
    reason: tuple[str, ...]

    def at(self, t: float) -> str:
        """The state at a time (s); "" before the first."""
        index = int(np.searchsorted(self.t, t, side="right")) - 1
        return self.state[index] if index >= 0 else ""


class Event(NamedTuple):
    """What a fault rule did to a process on purpose: t (s), robot, process (``agent``, ``plant``), what
    (``kill``, ``start``, ``stop``, ``cont``)."""

    t: float
    robot: int
    process: str
    what: str


class Robot:
    """All that one robot sent, at its own times (s of fleet time, below 0 before the start)."""

    def __init__(self, data: RobotData) -> None:
        self._data = data
        self.id = data.id

    @cached_property
    def poses(self) -> Poses:
        body = self._data.body
        return Poses(body.t, *(body[name] for name in Poses._fields[1:]))

    @cached_property
    def hand(self) -> Hands:
        hand = self._data.hand
        velocity = _pair(hand, "vx", "vy")
        forces = (_pair(hand, f"{name}_x", f"{name}_y") for name in Hands._fields[3:])
        return Hands(hand.t, _pair(hand, "x", "y"), velocity, *forces)

    @cached_property
    def wrenches(self) -> Wrenches:
        wrench = self._data.wrench
        return Wrenches(wrench.t, *(wrench[name] for name in Wrenches._fields[1:]))

    @cached_property
    def states(self) -> States:
        changes = self._data.status.changes()
        return States(
            np.array([change.t_s for change in changes], dtype=np.float64),
            tuple(change.state for change in changes),
            tuple(change.reason for change in changes),
        )

    def __repr__(self) -> str:
        return f"<Robot {self.id}: {len(self._data.body)} poses, {len(self._data.hand)} hand states>"


def _pair(table: Table, x: str, y: str) -> Floats:
    return np.column_stack([table[x], table[y]])


class Recording:
    """A run that has ended, in virtual time or real.

    What is by robot or by edge is for a common time, `times`; NaN where it is not known, or a robot has no
    place, or an edge is not in force. What each robot sent, at its own times, is in `robots`.

    Attributes:
        folder: where its files are; None where it is in memory alone (`save`).
    """

    def __init__(
        self, result: RunResult, folder: Path | None = None, write: Callable[[Path, bool], None] | None = None
    ) -> None:
        self._result, self.folder, self._write = result, folder, write

    # --- what it is of -----------------------------------------------------------------------------

    @property
    def _data(self) -> Data:
        return self._result.recording

    @cached_property
    def fleet(self) -> Fleet:
        """The fleet as it was driven."""
        from handfast.deploy.api.fleet import Fleet

        if self._data.fleet_toml is not None:
            return Fleet(self._data.fleet_toml, str(self.folder or "the recording"), recorded=True)
        import tomli_w

        from handfast.agent.fleet.loading import to_dict

        return Fleet(tomli_w.dumps(to_dict(self._data.fleet)), "the recording", recorded=True)

    @property
    def ids(self) -> tuple[int, ...]:
        return self._data.ids

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """The two robots of each edge that was ever in force."""
        ids = self.ids
        return tuple((ids[i], ids[j]) for i, j in self._result.analysis.edges.tolist())

    @property
    def mode(self) -> str:
        """``simulate`` or ``run``."""
        return self._data.mode

    @property
    def seed(self) -> int:
        return self._data.seed

    # --- columns -----------------------------------------------------------------------------------

    @property
    def times(self) -> Floats:
        """(k,) s: every period of the fleet from the start to the end of the drive."""
        return self._result.analysis.grid

    @cached_property
    def hands(self) -> Mapping[int, Floats]:
        """(k, 2) m by robot: where its hand point was, by its pose."""
        return self._by_robot(self._result.analysis.hands)

    @cached_property
    def desired(self) -> Mapping[int, Floats]:
        """(k, 2) m by robot: where its hand point was to be."""
        return self._by_robot(self._result.analysis.desired)

    @cached_property
    def distances(self) -> Mapping[tuple[int, int], Floats]:
        """(k,) m by edge: between the hand points of its robots."""
        return self._by_edge(self._result.analysis.distances)

    @cached_property
    def wanted(self) -> Mapping[tuple[int, int], Floats]:
        """(k,) m by edge: the distance that they were to keep."""
        return self._by_edge(self._result.analysis.wanted)

    def distance(self, one: int, other: int) -> Floats:
        """(k,) m between the hand points of any two robots.

        Raises:
            Error: there is no such robot.
        """
        between = self.hands[one] - self.hands[other]
        length: Floats = np.hypot(between[:, 0], between[:, 1])
        return length

    @cached_property
    def robots(self) -> Mapping[int, Robot]:
        """By robot: poses, hand states with forces, wrenches, states, at its own times."""
        return Known("robot", {robot: Robot(data) for robot, data in self._data.robots.items()})

    @cached_property
    def events(self) -> Sequence[Event]:
        """What fault rules did to processes."""
        return tuple(
            Event(self._data.fleet_time_s(event.time_ns), event.robot, event.role, event.what)
            for event in self._data.events
        )

    def _by_robot(self, values: Floats) -> Mapping[int, Floats]:
        return Known("robot", {robot: values[:, index] for index, robot in enumerate(self.ids)})

    def _by_edge(self, values: Floats) -> Mapping[tuple[int, int], Floats]:
        return Known("edge", {edge: values[:, index] for index, edge in enumerate(self.edges)})

    # --- tables ------------------------------------------------------------------------------------

    @cached_property
    def tables(self) -> Mapping[str, Columns]:
        """All tables of ``handfast export``, their columns by name: ``hands``, ``plants``, ``wrenches``,
        ``multipliers``, ``statuses``, ``distances``; ``links`` and ``truths`` where there are."""
        from handfast.deploy.report.export import tabulate

        found = tabulate(self._result)
        return Known("table", {name: Known("column", columns) for name, columns in found.items()})

    def frame(self, name: str) -> pandas.DataFrame:
        """One of `tables` as a pandas DataFrame.

        Raises:
            Error: there is no such table, or pandas is not installed.
        """
        return data_frame(self.tables[name], "Recording.frame")

    # --- what came of it ---------------------------------------------------------------------------

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        return self._result.metrics

    @property
    def passed(self) -> bool:
        """The verdict, as that of ``handfast run``."""
        return self._result.passed

    @property
    def reasons(self) -> Sequence[str]:
        """Why the verdict failed, as sentences."""
        return self._result.reasons

    @property
    def warnings(self) -> Sequence[str]:
        return self._result.warnings

    @packages_named("Recording.plot")
    def plot(self, name: str = "trajectories") -> Figure:
        """A picture of the report, as a matplotlib Figure: ``trajectories``, ``distances``, ``forces``,
        ``timing`` or ``links``.

        Raises:
            Error: there is no such picture, or matplotlib is not installed.
        """
        from handfast.deploy.report.figures import PICTURES, figure

        Known("picture", PICTURES)[name]
        return figure(self._result, name)

    @packages_named("Recording.save")
    def save(self, folder: str | Path, *, report: bool = True) -> Path:
        """Writes a run's folder, as ``handfast run`` and ``simulate`` do: recording, fleet file, metrics and,
        if asked, figures and report. Returns its path.

        Args:
            folder: empty or new.

        Raises:
            Error: it cannot be written.
        """
        flags(report=report)
        path = a_path(folder, "the folder")
        if self._write is not None:
            self._write(path, report)
            self.folder = self.folder or path
            return path
        assert self.folder is not None
        try:
            with in_words_of_python():
                refuse_full(path)
            shutil.copytree(self.folder, path, dirs_exist_ok=True)
        except OSError as error:
            raise Error(f"cannot copy {self.folder} to {path}: {error.strerror or error}") from None
        return path

    # --- how it shows itself -----------------------------------------------------------------------

    def __repr__(self) -> str:
        metrics, count = self.metrics, len(self.ids)
        robots = f"{count} robot{'s' * (count != 1)}"
        more = f" ... and {len(self.reasons) - 1} more" if len(self.reasons) > 1 else ""
        verdict = "passed" if self.passed else f"failed: {self.reasons[0]}{more}"
        where = f", {self.folder}" if self.folder is not None else ""
        return (
            f"<Recording {metrics['fleet']}: {self.mode}, {robots}, {metrics['duration_s']:g} s, "
            f"{verdict}{where}>"
        )

    def _repr_html_(self) -> str:
        said = [*self.reasons, *(f"Warning: {warning}" for warning in self.warnings)]
        rows = []
        for name in _SHOWN:
            value: Any = self.metrics
            for key in name.split("."):
                value = value[key]
            rows.append(f"<tr><td>{escape(name)}</td><td>{'–' if value is None else f'{value:g}'}</td></tr>")
        return (
            f"<p><b>{escape(str(self.metrics['fleet']))}</b>, {self.mode}, {len(self.ids)} robots, "
            f"{self.metrics['duration_s']:g} s: <b>{'passed' if self.passed else 'failed'}</b></p>"
            + "".join(f"<p>{escape(each)}</p>" for each in said)
            + f"<table>{''.join(rows)}</table>"
        )


@packages_named("handfast.load_recording")
def load_recording(folder: str | Path) -> Recording:
    """Reads a run's folder, as ``handfast run``, ``simulate``, ``drive`` and ``fetch`` leave it.

    Raises:
        Error: it is none, or cannot be read.
    """
    from handfast.deploy.recording.mcap_reader import read_run
    from handfast.deploy.verdict.run_result import RunResult

    path = a_path(folder, "the folder that a run has left")
    return Recording(RunResult(read_run(path)), path)


def data_frame(columns: Mapping[str, Any], what: str) -> pandas.DataFrame:
    """Columns as a DataFrame.

    Raises:
        Error: pandas is not installed.
    """
    try:
        import pandas as pd
    except ModuleNotFoundError:
        raise Error(f"{what} needs the package pandas: pip install pandas") from None
    return pd.DataFrame(dict(columns))
