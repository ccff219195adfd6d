"""The fleet as Foxglove's 3D panel draws it: a picture derived from the messages, never read back.

Three channels with Foxglove's well-known schemas (https://docs.foxglove.dev/docs/sdk/schemas): every
robot's pose as a transform, the formation's edges as lines between hand points, and the robots'
shapes, sent once, each in its own robot's frame. Only the parts of the schemas that are sent are
described; Foxglove goes by the schema's name.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from math import cos, sin
from typing import Any, Final

from agent.fleet.model import Fleet
from agent.formation.geometry import resolve
from agent.formation.mission_plan import PlanError, plan_of
from agent.formation.reference import Reference
from agent.messages.types import Mission, PlantState

PERIOD_NS: Final = 100_000_000
WORLD: Final = "world"
SCHEMA_PREFIX: Final = "foxglove."

_PALETTE: Final = (
    (0.0, 0.45, 0.70),
    (0.84, 0.37, 0.0),
    (0.0, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.34, 0.71, 0.91),
)
_EDGE: Final = {"r": 0.5, "g": 0.5, "b": 0.5, "a": 0.8}
_UPRIGHT: Final = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_ZERO_TIME: Final = {"sec": 0, "nsec": 0}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _list(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": item}


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
_SCENE: Final = _object("foxglove.SceneUpdate", deletions=_list(_DELETION), entities=_list(_ENTITY))
_TRANSFORMS: Final = _object(
    "foxglove.FrameTransforms",
    transforms=_list(
        _object(
            "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT,
            translation=_VECTOR, rotation=_QUATERNION,
        )
    ),
)  # fmt: skip

SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "foxglove.FrameTransforms": _TRANSFORMS,
    "foxglove.SceneUpdate": _SCENE,
}


def _dumps(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def _time(time_ns: int) -> dict[str, int]:
    return dict(zip(("sec", "nsec"), divmod(time_ns, 1_000_000_000), strict=True))


def _entity(name: str, frame: str, time_ns: int, **primitives: Any) -> dict[str, Any]:
    empty: dict[str, Any] = {"arrows": [], "cylinders": [], "lines": [], "texts": []}
    return {
        "timestamp": _time(time_ns), "frame_id": frame, "id": name, "lifetime": _ZERO_TIME,
        "frame_locked": True, "metadata": [], **empty, **primitives,
    }  # fmt: skip


def _pose(x: float, y: float, z: float) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": z}, "orientation": _UPRIGHT}


class Scene:
    """Collects poses and says, ten times a second, what the 3D panel shall draw.

    The shapes have the size of the hand offset: a robot's hand point is the tip of its arrow.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._offset = {robot.id: robot.hand_offset_m for robot in fleet.robots}
        self._fleet, self._geometry = fleet, resolve(fleet)
        self._reference = Reference(fleet, self._geometry)
        prefix = fleet.fleet.name
        self._shapes, self._poses, self._lines = (
            f"{prefix}/foxglove/{name}" for name in ("robots", "poses", "edges")
        )
        self._latest: dict[int, PlantState] = {}
        self._next_ns: int | None = None

    def take(self, mission: Mission) -> None:
        """Takes a mission: from its time on the edges are its own. One that cannot be driven is left out."""
        try:
            plan = plan_of(mission, self._fleet, self._geometry)
        except PlanError:
            return
        self._reference.take(plan)

    def update(self, now_ns: int, state: PlantState) -> Iterator[tuple[str, str, bytes]]:
        """Take one pose, if it may be used; yields (key, schema name, JSON) when a picture is due.

        now_ns: the time of the recording, that of reception.
        """
        if state.robot not in self._offset or not state.healthy:
            return
        self._latest[state.robot] = state
        if self._next_ns is not None and now_ns < self._next_ns:
            return
        if self._next_ns is None:
            yield self._shapes, "foxglove.SceneUpdate", self._draw_shapes(now_ns)
        self._next_ns = now_ns - now_ns % PERIOD_NS + PERIOD_NS
        yield self._poses, "foxglove.FrameTransforms", self._draw_poses(now_ns)
        yield self._lines, "foxglove.SceneUpdate", self._draw_edges(now_ns)

    def _draw_shapes(self, now_ns: int) -> bytes:
        entities = []
        for index, (robot, offset) in enumerate(self._offset.items()):
            red, green, blue = _PALETTE[index % len(_PALETTE)]
            color = {"r": red, "g": green, "b": blue, "a": 0.9}
            size = abs(offset)
            direction = _UPRIGHT if offset >= 0 else {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}
            body = {
                "pose": _pose(0.0, 0.0, size / 4), "size": {"x": size, "y": size, "z": size / 2},
                "bottom_scale": 1.0, "top_scale": 1.0, "color": color,
            }  # fmt: skip
            arrow = {
                "pose": _pose(0.0, 0.0, size / 2) | {"orientation": direction},
                "shaft_length": 0.6 * size, "shaft_diameter": 0.15 * size,
                "head_length": 0.4 * size, "head_diameter": 0.4 * size, "color": color,
            }  # fmt: skip
            label = {
                "pose": _pose(0.0, 0.0, 1.5 * size), "billboard": True, "font_size": 14.0,
                "scale_invariant": True, "color": color, "text": str(robot),
            }  # fmt: skip
            shapes = {"cylinders": [body], "arrows": [arrow], "texts": [label]}
            entities.append(_entity(f"robot {robot}", f"robot/{robot}", now_ns, **shapes))
        return _dumps({"deletions": [], "entities": entities})

    def _draw_poses(self, now_ns: int) -> bytes:
        stamp = _time(now_ns)
        transforms = [
            {
                "timestamp": stamp, "parent_frame_id": WORLD, "child_frame_id": f"robot/{robot}",
                "translation": {"x": state.x, "y": state.y, "z": 0.0},
                "rotation": {"x": 0.0, "y": 0.0, "z": sin(state.heading / 2), "w": cos(state.heading / 2)},
            }
            for robot, state in self._latest.items()
        ]  # fmt: skip
        return _dumps({"transforms": transforms})

    def _draw_edges(self, now_ns: int) -> bytes:
        hands = {
            robot: {
                "x": state.x + self._offset[robot] * cos(state.heading),
                "y": state.y + self._offset[robot] * sin(state.heading),
                "z": 0.0,
            }
            for robot, state in self._latest.items()
        }
        points = [
            hands[end]
            for robot in hands
            for edge in self._reference.edges(robot, now_ns)
            if robot < edge.other and edge.other in hands
            for end in (robot, edge.other)
        ]
        line = {
            "type": 2, "pose": _pose(0.0, 0.0, 0.0), "thickness": 2.0, "scale_invariant": True,
            "points": points, "color": _EDGE, "colors": [], "indices": [],
        }  # fmt: skip
        return _dumps({"deletions": [], "entities": [_entity("formation", WORLD, now_ns, lines=[line])]})
