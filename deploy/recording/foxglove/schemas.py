"""The topics that Foxglove is given, and the JSON schema of each.

Most are Foxglove's well-known schemas (https://docs.foxglove.dev/docs/sdk/schemas), of which only the parts
that are sent are described: Foxglove goes by the schema's name. Its Diagnostics panels know
``diagnostic_msgs/DiagnosticArray`` of ROS alone.

Topics do not hold the fleet's name, so that one layout opens every fleet. None is a key of the bus: those do
not begin with a slash.
"""

from __future__ import annotations

from typing import Any, Final

POSES: Final = "/foxglove/poses"
"""Where every robot is, and the formation's reference point, as transforms."""
ROBOTS: Final = "/foxglove/robots"
"""The robots' shapes, and the disc that nobody else's may touch; each in its robot's frame."""
EDGES: Final = "/foxglove/edges"
"""The formation's edges, coloured by their error, and ways of robots to their places."""
PLACES: Final = "/foxglove/places"
"""The formation's places, in the frame of its reference point."""
GROUND: Final = "/foxglove/ground"
"""Obstacles and geofence."""
SILENT: Final = "/foxglove/silent"
"""Where robots that are not heard are believed to be."""
PLOTS: Final = "/foxglove/plots"
"""Numbers of every robot and edge."""
DIAGNOSTICS: Final = "/foxglove/diagnostics"
"""The state of every robot, and why."""
LOG: Final = "/foxglove/log"
"""What happens."""

SCENE_UPDATE: Final = "foxglove.SceneUpdate"
TOPICS: Final = {
    POSES: "foxglove.FrameTransforms",
    ROBOTS: SCENE_UPDATE,
    EDGES: SCENE_UPDATE,
    PLACES: SCENE_UPDATE,
    GROUND: SCENE_UPDATE,
    SILENT: SCENE_UPDATE,
    PLOTS: "handfast.Plots",
    DIAGNOSTICS: "diagnostic_msgs/DiagnosticArray",
    LOG: "foxglove.Log",
}
"""Every topic, and the name of its schema."""


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _list(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": item}


def _about(kind: dict[str, Any], description: str) -> dict[str, Any]:
    return {**kind, "description": description}


_NUMBER: Final[dict[str, Any]] = {"type": "number"}
_TEXT: Final[dict[str, Any]] = {"type": "string"}
_FLAG: Final[dict[str, Any]] = {"type": "boolean"}
_INTEGER: Final[dict[str, Any]] = {"type": "integer"}
_TIME: Final = _object("time", sec=_INTEGER, nsec=_INTEGER)
_DURATION: Final = _object("duration", sec=_INTEGER, nsec=_INTEGER)
_VECTOR: Final = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT: Final = _object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOR: Final = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_ARROW: Final = _object(
    "foxglove.ArrowPrimitive", pose=_POSE, shaft_length=_NUMBER, shaft_diameter=_NUMBER,
    head_length=_NUMBER, head_diameter=_NUMBER, color=_COLOR,
)  # fmt: skip
_CYLINDER: Final = _object(
    "foxglove.CylinderPrimitive",
    pose=_POSE,
    size=_VECTOR,
    bottom_scale=_NUMBER,
    top_scale=_NUMBER,
    color=_COLOR,
)
_LINE: Final = _object(
    "foxglove.LinePrimitive", type=_INTEGER, pose=_POSE, thickness=_NUMBER, scale_invariant=_FLAG,
    points=_list(_POINT), color=_COLOR, colors=_list(_COLOR), indices=_list(_INTEGER),
)  # fmt: skip
_LABEL: Final = _object(
    "foxglove.TextPrimitive", pose=_POSE, billboard=_FLAG, font_size=_NUMBER, scale_invariant=_FLAG,
    color=_COLOR, text=_TEXT,
)  # fmt: skip
_ENTITY: Final = _object(
    "foxglove.SceneEntity", timestamp=_TIME, frame_id=_TEXT, id=_TEXT, lifetime=_DURATION, frame_locked=_FLAG,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list(_ARROW), cylinders=_list(_CYLINDER), lines=_list(_LINE), texts=_list(_LABEL),
)  # fmt: skip
_DELETION: Final = _object("foxglove.SceneEntityDeletion", timestamp=_TIME, type=_INTEGER, id=_TEXT)
_SCENE: Final = _object(SCENE_UPDATE, deletions=_list(_DELETION), entities=_list(_ENTITY))
_TRANSFORMS: Final = _object(
    "foxglove.FrameTransforms",
    transforms=_list(
        _object(
            "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT,
            translation=_VECTOR, rotation=_QUATERNION,
        )
    ),
)  # fmt: skip
_LOG: Final = _object(
    "foxglove.Log", timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER
)
_DIAGNOSTICS: Final = _object(
    "diagnostic_msgs/DiagnosticArray",
    header=_object("std_msgs/Header", stamp=_TIME, frame_id=_TEXT),
    status=_list(
        _object(
            "diagnostic_msgs/DiagnosticStatus", level=_INTEGER, name=_TEXT, message=_TEXT, hardware_id=_TEXT,
            values=_list(_object("diagnostic_msgs/KeyValue", key=_TEXT, value=_TEXT)),
        )
    ),
)  # fmt: skip
_PLOTTED_ROBOT: Final = _object(
    "handfast.PlottedRobot",
    label=_about(_TEXT, "Its name, such as 'robot 3'"),
    id=_about(_INTEGER, "Its number"),
    place_error_m=_about(_NUMBER, "How far its hand point is from its place, m"),
    nearest_m=_about(_NUMBER, "How far the nearest other hand point is, m"),
    speed_m_s=_about(_NUMBER, "Speed of its body, m/s; where no plant is heard that of its hand point"),
    age_ms=_about(_NUMBER, "Age of the oldest neighbour's hand state that it acts on, ms"),
    tick_us=_about(_INTEGER, "Its longest tick since the status before, us; none in virtual time"),
)
_PLOTTED_EDGE: Final = _object(
    "handfast.PlottedEdge",
    label=_about(_TEXT, "Its robots, such as '1-2'"),
    error_m=_about(_NUMBER, "Distance of its hand points minus the wanted one, m"),
)
_PLOTS: Final = {
    **_object(
        "handfast.Plots",
        least_distance_m=_about(_NUMBER, "Least distance of any two hand points, m"),
        safe_distance_m=_about(_NUMBER, "formation.safe_distance_m"),
        worst_edge_error_m=_about(_NUMBER, "Greatest error of an edge, m"),
        worst_place_error_m=_about(_NUMBER, "How far the robot farthest from its place is from there, m"),
        robots=_list(_PLOTTED_ROBOT),
        edges=_list(_PLOTTED_EDGE),
    ),
    "description": "The fleet in numbers. What is not known is left out.",
}

SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "foxglove.FrameTransforms": _TRANSFORMS,
    SCENE_UPDATE: _SCENE,
    "foxglove.Log": _LOG,
    "diagnostic_msgs/DiagnosticArray": _DIAGNOSTICS,
    "handfast.Plots": _PLOTS,
}
"""By its name."""
