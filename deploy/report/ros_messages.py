"""A run as messages of ROS 2: its topics, types and frames, and their bytes (CDR).

The map is the world: x east, y north (ENU, REP 103). Frames are named by REP 105; a robot's are
`robot_N/base_link`, x ahead (FLU), and `robot_N/hand`, its hand point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from handfast.agent.formation.points import Floats
from handfast.deploy.analysis.stability import SETTLED
from handfast.deploy.playback.marks import (
    DRIVES,
    FAILED,
    FAULT,
    LOOKS,
    ORDER,
    RESTS,
    STATE,
    TROUBLED,
    UNREADY,
    VIOLATION,
    marks,
)
from handfast.deploy.playback.scene import nearest
from handfast.deploy.recording.recording import RobotData
from handfast.deploy.recording.tables import StatusTable, Table
from handfast.deploy.verdict.run_result import RunResult

STORE: Final = get_typestore(Stores.ROS2_HUMBLE)
"""The definitions of the types. Those that are used are the same in Jazzy."""
MAP: Final = "map"
VOLATILE: Final = "volatile"
LATCHED: Final = "latched"
LOG: Final = "log"
EDGES_HZ: Final = 10.0
EDGE_TOPICS_MAX: Final = 200
"""Of more edges only the worst error has a topic, not each one's."""
PATH_POSES_MAX: Final = 500

_BLOCK_ROWS: Final = 1024
_STAMP_BYTE: Final = 4
"""Where a header's stamp is in a message that begins with one: behind the head of CDR."""
_QZ, _QW = 5, 6  # columns of a pose as seven numbers
_LEVELS: Final[Mapping[str, int]] = {DRIVES: 0, RESTS: 0, UNREADY: 0, TROUBLED: 1, FAILED: 2}
"""Of diagnostic_msgs/DiagnosticStatus: OK, WARN, ERROR. To rest or to wait is fine."""
_INFO, _WARN, _ERROR = 20, 30, 40  # of rcl_interfaces/Log
_STATE_SEVERITIES: Final[Mapping[str, int]] = {TROUBLED: _WARN, FAILED: _ERROR}
_MARK_SEVERITIES: Final[Mapping[str, int]] = {ORDER: _INFO, FAULT: _WARN, VIOLATION: _ERROR}
_MARK_LOGGERS: Final[Mapping[str, str]] = {ORDER: "operator", FAULT: "faults", VIOLATION: "verdict"}
_HOLDS, _OFF, _UNSAFE = (0.0, 0.6, 0.4, 0.9), (0.9, 0.6, 0.0, 0.9), (0.8, 0.1, 0.1, 1.0)
_EDGE_WIDTH_M: Final = 0.02

Ints = NDArray[np.int64]


class Stream(NamedTuple):
    """Messages on a topic, in the order of time; several may share a topic.

    Attributes:
        qos: `VOLATILE`; `LATCHED`: whoever subscribes later gets the last one too; `LOG`: that of /rosout.
        times_ns: (n,) ascending, since the Unix epoch.
        messages: n of them as CDR, each made when it is taken; to be taken once.
    """

    topic: str
    type: str
    qos: str
    times_ns: Ints
    messages: Iterator[bytes]


def streams(result: RunResult) -> list[Stream]:
    """All that a bag holds of a run whose epoch is known; streams without a message are left out."""
    found = [*_of_robots(result), *_of_formation(result), _log(result)]
    found = [stream for stream in found if len(stream.times_ns)]
    if found:
        first_ns = min(int(stream.times_ns[0]) for stream in found)
        found.insert(0, _static_frames(result, first_ns))
    return found


def base_frame(robot: int) -> str:
    """The frame of a robot's body: its axle's middle, x ahead."""
    return f"robot_{robot}/base_link"


def hand_frame(robot: int) -> str:
    """The frame of a robot's hand point."""
    return f"robot_{robot}/hand"


# --- what there is ---------------------------------------------------------------------------


def _of_robots(result: RunResult) -> Iterator[Stream]:
    recording, analysis = result.recording, result.analysis
    epoch_ns = recording.epoch_ns or 0
    grid_ns = _ns(epoch_ns, analysis.grid)
    for index, (robot, data) in enumerate(recording.robots.items()):
        yield from _motion(robot, data, epoch_ns)
        places = analysis.desired[:, index]
        known = np.isfinite(places).all(axis=1)
        numbers = np.zeros((int(known.sum()), 7))
        numbers[:, :2], numbers[:, _QW] = places[known], 1.0
        yield _poses(f"/robot_{robot}/wanted", grid_ns[known], numbers)
        yield _diagnostics(robot, data.status, epoch_ns)


def _motion(robot: int, data: RobotData, epoch_ns: int) -> Iterator[Stream]:
    """Where a body was, as well as that is known (`RobotData.body`), and what its plant measured."""
    base = base_frame(robot)
    times_ns, poses = _ns(epoch_ns, data.body.t), _pose_numbers(data.body)
    frame = _new("tf2_msgs/msg/TFMessage", [_transform(base, MAP)])
    yield Stream(
        "/tf",
        "tf2_msgs/msg/TFMessage",
        VOLATILE,
        times_ns,
        _filled("tf2_msgs/msg/TFMessage", frame, times_ns, {7: poses}, _STAMP_BYTE + 4),
    )
    yield _poses(f"/robot_{robot}/pose", times_ns, poses)
    yield _path(robot, times_ns, poses)
    measured = data.plant.only(data.plant["healthy"] > 0.0)
    twists = np.zeros((len(measured), 6))
    twists[:, 0], twists[:, 5] = measured["speed"], measured["yaw_rate"]
    unknown = np.zeros(36)  # covariances
    odometry = _new(
        "nav_msgs/msg/Odometry",
        *(_header(MAP), base),
        _new("geometry_msgs/msg/PoseWithCovariance", _pose(), unknown),
        _new("geometry_msgs/msg/TwistWithCovariance", _twist(), unknown),
    )
    measured_ns = _ns(epoch_ns, measured.t)
    numbers = {36 + 6 + 36 + 7: _pose_numbers(measured), 36 + 6: twists}
    yield Stream(
        f"/robot_{robot}/odom",
        "nav_msgs/msg/Odometry",
        VOLATILE,
        measured_ns,
        _filled("nav_msgs/msg/Odometry", odometry, measured_ns, numbers, _STAMP_BYTE),
    )


def _of_formation(result: RunResult) -> Iterator[Stream]:
    analysis = result.analysis
    grid_ns = _ns(result.recording.epoch_ns or 0, analysis.grid)
    yield _edges(result, grid_ns)
    errors = analysis.distances - analysis.wanted
    if len(analysis.edges) <= EDGE_TOPICS_MAX:
        for column, (i, j) in enumerate(analysis.edges.tolist()):
            low, high = sorted((analysis.ids[i], analysis.ids[j]))
            yield _numbers(f"/edge_{low}_{high}/error", grid_ns, errors[:, column])
    worst = np.where(np.isfinite(errors), np.abs(errors), -1.0).max(axis=1, initial=-1.0)
    yield _numbers("/formation_error", grid_ns, np.where(worst < 0.0, np.nan, worst))
    yield _numbers("/min_distance", grid_ns, nearest(analysis))


def _edges(result: RunResult, grid_ns: Ints) -> Stream:
    """The edges in force between hand points, as lines: green within 5 % of the wanted distance, yellow
    further off, red below the safe distance."""
    analysis = result.analysis
    rows = np.arange(0, len(grid_ns), max(1, int(np.ceil(result.fleet.fleet.rate_hz / EDGES_HZ))))
    palette = [_new("std_msgs/msg/ColorRGBA", *color) for color in (_HOLDS, _OFF, _UNSAFE)]

    def pictures() -> Iterator[Any]:
        for k in rows.tolist():
            distances, wanted = analysis.distances[k], analysis.wanted[k]
            shown = np.flatnonzero(np.isfinite(distances) & np.isfinite(wanted))
            distances, wanted = distances[shown], wanted[shown]
            looks = np.where(np.abs(distances - wanted) <= SETTLED * wanted, 0, 1)
            looks[distances < analysis.safe_m] = 2
            ends = analysis.hands[k][analysis.edges[shown]].reshape(-1, 2)
            points = [_new("geometry_msgs/msg/Point", x, y, 0.0) for x, y in ends.tolist()]
            colors = [palette[look] for look in looks.tolist() for _end in range(2)]
            yield _new(kind, [_marker(int(grid_ns[k]), points, colors)])

    kind = "visualization_msgs/msg/MarkerArray"
    return Stream("/edges", kind, VOLATILE, grid_ns[rows], _serialised(kind, pictures()))


def _marker(time_ns: int, points: Sequence[Any], colors: Sequence[Any]) -> Any:
    kind: Any = STORE.types["visualization_msgs/msg/Marker"]
    return kind(
        header=_header(MAP, time_ns),
        ns="edges",
        id=0,
        type=kind.LINE_LIST,
        # RViz wants points in a list of lines: where there are none, what it drew before is taken away.
        action=kind.ADD if points else kind.DELETE,
        pose=_pose(),
        scale=_new("geometry_msgs/msg/Vector3", _EDGE_WIDTH_M, 0.0, 0.0),
        color=_new("std_msgs/msg/ColorRGBA", *_HOLDS),
        lifetime=_new("builtin_interfaces/msg/Duration", 0, 0),
        frame_locked=False,
        points=points,
        colors=colors,
        texture_resource="",
        texture=_new("sensor_msgs/msg/CompressedImage", _header(""), "", np.zeros(0, dtype=np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=_new("visualization_msgs/msg/MeshFile", "", np.zeros(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _path(robot: int, times_ns: Ints, poses: Floats) -> Stream:
    """The path that a body has driven, once, at its end, thinned."""
    kind = "nav_msgs/msg/Path"
    last_ns = times_ns[-1:]

    def path() -> Iterator[Any]:
        if len(times_ns):
            chosen = np.unique(np.linspace(0, len(times_ns) - 1, PATH_POSES_MAX).round().astype(np.int64))
            stamped = [
                _new("geometry_msgs/msg/PoseStamped", _header(MAP, time_ns), _pose(*numbers))
                for time_ns, numbers in zip(times_ns[chosen].tolist(), poses[chosen].tolist(), strict=True)
            ]
            yield _new(kind, _header(MAP, int(times_ns[-1])), stamped)

    return Stream(f"/robot_{robot}/path", kind, LATCHED, last_ns, _serialised(kind, path()))


def _diagnostics(robot: int, status: StatusTable, epoch_ns: int) -> Stream:
    """What an agent says of itself: its state and why, the greatest age of a neighbour's message and the
    longest tick since it said so last, and how many ticks it has missed since it started."""
    times_ns = _ns(epoch_ns, status.t)
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    name = f"robot_{robot}"

    def arrays() -> Iterator[Any]:
        ages_ms, ticks_us = (status.age_max_us / 1e3).tolist(), status.tick_max_us.tolist()
        for k, (time_ns, state, reason) in enumerate(
            zip(times_ns.tolist(), status.states, status.reasons, strict=True)
        ):
            values = {
                "state": state,
                "age_max_ms": _text(ages_ms[k]),
                "tick_max_us": _text(ticks_us[k]),
                "overruns": str(status.counters[k].get("overruns", 0)),
            }
            pairs = [_new("diagnostic_msgs/msg/KeyValue", *pair) for pair in values.items() if pair[1]]
            level = _LEVELS[LOOKS.get(state, UNREADY)]
            said = (level, name, _said(state, reason), name, pairs)
            yield _new(kind, _header("", time_ns), [_new("diagnostic_msgs/msg/DiagnosticStatus", *said)])

    return Stream("/diagnostics", kind, VOLATILE, times_ns, _serialised(kind, arrays()))


def _log(result: RunResult) -> Stream:
    """What happened, as lines: every change of a robot's state, orders, faults, violations."""
    lines: list[tuple[float, int, str, str]] = []
    for robot, data in result.recording.robots.items():
        for change in data.status.changes():
            severity = _STATE_SEVERITIES.get(LOOKS.get(change.state, UNREADY), _INFO)
            lines.append((change.t_s, severity, f"robot_{robot}", _said(change.state, change.reason)))
    for mark in marks(result):
        if mark.kind == STATE:
            continue  # above robot by robot, with those that need no mark
        logger = _MARK_LOGGERS[mark.kind]
        lines.append((mark.t_s, _MARK_SEVERITIES[mark.kind], logger, mark.text))
        if mark.end_s is not None:
            lines.append((mark.end_s, _INFO, logger, f"over: {mark.text}"))
    lines = sorted((line for line in lines if isfinite(line[0])), key=lambda line: line[0])
    times_ns = _ns(result.recording.epoch_ns or 0, np.array([line[0] for line in lines], dtype=np.float64))
    kind = "rcl_interfaces/msg/Log"
    logs = (
        _new(kind, _time(time_ns), severity, name, text, "", "", 0)
        for time_ns, (_, severity, name, text) in zip(times_ns.tolist(), lines, strict=True)
    )
    return Stream("/rosout", kind, LOG, times_ns, _serialised(kind, logs))


def _static_frames(result: RunResult, time_ns: int) -> Stream:
    """Where hand points are on their bodies, in one message: of a latched topic late comers get the last."""
    kind = "tf2_msgs/msg/TFMessage"
    frames = [
        _transform(hand_frame(robot.id), base_frame(robot.id), robot.hand_offset_m, time_ns)
        for robot in result.fleet.robots
    ]
    return Stream(
        "/tf_static", kind, LATCHED, np.array([time_ns]), _serialised(kind, iter([_new(kind, frames)]))
    )


def _said(state: str, reason: str) -> str:
    return f"{state}: {reason}" if reason else state


def _text(number: float) -> str:
    return f"{number:g}" if isfinite(number) else ""


# --- messages --------------------------------------------------------------------------------


def _ns(epoch_ns: int, t: Floats) -> Ints:
    """Fleet time (s) as nanoseconds since the Unix epoch."""
    times_ns: Ints = epoch_ns + np.rint(t * 1e9).astype(np.int64)
    return times_ns


def _new(kind: str, *values: Any) -> Any:
    cls: Any = STORE.types[kind]
    return cls(*values)


def _time(time_ns: int) -> Any:
    return _new("builtin_interfaces/msg/Time", *divmod(time_ns, 1_000_000_000))


def _header(frame: str, time_ns: int = 0) -> Any:
    return _new("std_msgs/msg/Header", _time(time_ns), frame)


def _pose(*numbers: float) -> Any:
    x, y, z, *turn = numbers or (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    place = _new("geometry_msgs/msg/Point", x, y, z)
    return _new("geometry_msgs/msg/Pose", place, _new("geometry_msgs/msg/Quaternion", *turn))


def _twist() -> Any:
    zero = _new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    return _new("geometry_msgs/msg/Twist", zero, zero)


def _transform(child: str, parent: str, x: float = 0.0, time_ns: int = 0) -> Any:
    moved = _new("geometry_msgs/msg/Vector3", x, 0.0, 0.0)
    upright = _new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    frame = _new("geometry_msgs/msg/Transform", moved, upright)
    return _new("geometry_msgs/msg/TransformStamped", _header(parent, time_ns), child, frame)


def _pose_numbers(table: Table) -> Floats:
    """Poses (n, 7): x, y, z (m, W) and the quaternion x, y, z, w."""
    numbers = np.zeros((len(table), 7))
    # Without jumps of a whole turn, in which the quaternion would change its sign.
    half = np.unwrap(table["heading"]) / 2.0
    numbers[:, 0], numbers[:, 1] = table["x"], table["y"]
    numbers[:, _QZ], numbers[:, _QW] = np.sin(half), np.cos(half)
    return numbers


def _poses(topic: str, times_ns: Ints, numbers: Floats) -> Stream:
    kind = "geometry_msgs/msg/PoseStamped"
    one = _new(kind, _header(MAP), _pose())
    return Stream(topic, kind, VOLATILE, times_ns, _filled(kind, one, times_ns, {7: numbers}, _STAMP_BYTE))


def _numbers(topic: str, times_ns: Ints, values: Floats) -> Stream:
    """A number over time, where it is known."""
    kind = "std_msgs/msg/Float64"
    known = np.isfinite(values)
    times_ns, values = times_ns[known], values[known]
    return Stream(
        topic, kind, VOLATILE, times_ns, _filled(kind, _new(kind, 0.0), times_ns, {1: values[:, None]})
    )


def _serialised(kind: str, messages: Iterable[Any]) -> Iterator[bytes]:
    for message in messages:
        yield bytes(STORE.serialize_cdr(message, kind, little_endian=True))


def _filled(
    kind: str, message: Any, times_ns: Ints, numbers: Mapping[int, Floats], stamp_byte: int | None = None
) -> Iterator[bytes]:
    """One message again and again, with other numbers: a hundred times as fast as one by one.

    numbers: float64 (n, k) by their place, so many float64 before the end: in CDR all of a message whose
        texts come before its numbers has its place. stamp_byte: where the stamp is, None without.
    """
    template = np.frombuffer(STORE.serialize_cdr(message, kind, little_endian=True), dtype=np.uint8)
    size = len(template)
    fields: dict[str, tuple[Any, int]] = {
        f"{place}": (("<f8", values.shape[1:]), size - 8 * place) for place, values in numbers.items()
    }
    if stamp_byte is not None:
        fields |= {"sec": ("<i4", stamp_byte), "nanosec": ("<u4", stamp_byte + 4)}
    formats, offsets = zip(*fields.values(), strict=True)
    layout = np.dtype({"names": [*fields], "formats": [*formats], "offsets": [*offsets], "itemsize": size})
    for first in range(0, len(times_ns), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        times = times_ns[rows]
        block = np.tile(template, (len(times), 1)).view(layout)[:, 0]
        for place, values in numbers.items():
            block[f"{place}"] = values[rows]
        if stamp_byte is not None:
            block["sec"], block["nanosec"] = np.divmod(times, 1_000_000_000)
        content = block.tobytes()
        for start in range(0, len(content), size):
            yield content[start : start + size]
