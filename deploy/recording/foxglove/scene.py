"""What Foxglove's 3D panel draws: the content of the scene's topics (PURE).

Lengths in m. Each content is the whole of its topic, so that the last message of each is the picture, from
whatever moment somebody looks at it on. Where the time belongs stands `STAMP`.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import cos, hypot, sin
from typing import Any, Final

from handfast.agent.common.quantities import Vector
from handfast.agent.control.boundaries import Circle, fence_of, obstacles_of
from handfast.agent.fleet.model import Fleet
from handfast.deploy.recording.foxglove.json_text import STAMP, dumps
from handfast.deploy.recording.foxglove.moment import HOLDS, Link, Moment

WORLD: Final = "world"
FORMATION: Final = "formation"
"""The frame of the formation's reference point: east and north as in W."""

_PALETTE: Final = (
    (0.0, 0.45, 0.70),
    (0.84, 0.37, 0.0),
    (0.0, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.34, 0.71, 0.91),
)
# Of colours that people with any kind of colour blindness can tell apart (Okabe and Ito).
EDGE_COLORS: Final = {
    "holds": "#009e73",
    "too long": "#e69f00",
    "too short": "#cc79a7",
    "unsafe": "#d55e00",
}
_EDGE_PX: Final = {"holds": 2.0, "too long": 2.0, "too short": 4.0, "unsafe": 6.0}
_GREY: Final = "#808080"
_SILENT_COLOR: Final = "#cc79a7"
_UPRIGHT: Final = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_BACKWARD: Final = {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}
_DISC_HEIGHT_M: Final = 0.005
_OBSTACLE_HEIGHT_M: Final = 0.3
_CROSS_SHARE: Final = 0.3
"""Half the width of a place's cross, by the safe distance."""
_LINE_LOOP, _LINE_LIST = 1, 2

_TRANSFORM: Final = (
    '{"timestamp":' + STAMP + ',"parent_frame_id":"world","child_frame_id":"%s",'
    '"translation":{"x":%.3f,"y":%.3f,"z":0},"rotation":{"x":0,"y":0,"z":%.4f,"w":%.4f}}'
)
_TRANSFORMS: Final = '{"transforms":[%s]}'
_UPDATE: Final = '{"deletions":[],"entities":[%s]}'
_ENTITY: Final = (
    '{"timestamp":' + STAMP + ',"frame_id":%s,"id":%s,"lifetime":{"sec":0,"nsec":0},"frame_locked":true,'
    '"metadata":[],"arrows":[%s],"cylinders":[%s],"lines":[%s],"texts":[%s]}'
)
_LINE: Final = (
    '{"type":%d,"pose":{"position":{"x":0,"y":0,"z":0},"orientation":{"x":0,"y":0,"z":0,"w":1}},'
    '"thickness":%.1f,"scale_invariant":true,"points":[%s],"color":%s,"colors":[],"indices":[]}'
)
_POINT: Final = '{"x":%.3f,"y":%.3f,"z":0}'


def _color(code: str, alpha: float = 0.9) -> dict[str, float]:
    r, g, b = (round(int(code[k : k + 2], 16) / 255, 3) for k in (1, 3, 5))
    return {"r": r, "g": g, "b": b, "a": alpha}


def _line(kind: int, points: Iterable[Vector], code: str, pixels: float = 2.0) -> str:
    return _LINE % (kind, pixels, ",".join([_POINT % point for point in points]), dumps(_color(code)))


def _entity(
    name: str,
    frame: str,
    *,
    arrows: Iterable[str] = (),
    cylinders: Iterable[str] = (),
    lines: Iterable[str] = (),
    texts: Iterable[str] = (),
) -> str:
    parts = (",".join(part) for part in (arrows, cylinders, lines, texts))
    return _ENTITY % (dumps(frame), dumps(name), *parts)


def _update(entities: Iterable[str]) -> str:
    return _UPDATE % ",".join(entities)


def _pose(x: float, y: float, z: float) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": z}, "orientation": _UPRIGHT}


def _cylinder(place: Vector, diameter: float, height: float, color: dict[str, float]) -> str:
    return dumps(
        {
            "pose": _pose(*place, height / 2), "size": {"x": diameter, "y": diameter, "z": height},
            "bottom_scale": 1.0, "top_scale": 1.0, "color": color,
        }
    )  # fmt: skip


def _text(place: Vector, height: float, text: str, color: dict[str, float]) -> str:
    return dumps(
        {
            "pose": _pose(*place, height), "billboard": True, "font_size": 14.0, "scale_invariant": True,
            "color": color, "text": text,
        }
    )  # fmt: skip


def frame_of(robot: int) -> str:
    """The frame R of a robot."""
    return f"robot/{robot}"


# ---------------------------------------------------------------------- what does not change


def robots(fleet: Fleet) -> str:
    """The robots' shapes, each in its robot's frame: as large as the hand offset, so that the hand point is
    the tip of the arrow; about it a disc as wide as the safe distance: discs that touch are robots at it."""
    safe_m = fleet.formation.safe_distance_m
    entities = []
    for index, robot in enumerate(fleet.robots):
        red, green, blue = _PALETTE[index % len(_PALETTE)]
        color = {"r": red, "g": green, "b": blue, "a": 0.9}
        offset = robot.hand_offset_m
        size = abs(offset)
        arrow = {
            "pose": _pose(0.0, 0.0, size / 2) | {"orientation": _UPRIGHT if offset >= 0 else _BACKWARD},
            "shaft_length": 0.6 * size, "shaft_diameter": 0.15 * size,
            "head_length": 0.4 * size, "head_diameter": 0.4 * size, "color": color,
        }  # fmt: skip
        disc = _cylinder((offset, 0.0), safe_m, _DISC_HEIGHT_M, color | {"a": 0.25})
        shapes = {
            "cylinders": [_cylinder((0.0, 0.0), size, size / 2, color), disc],
            "arrows": [dumps(arrow)],
            "texts": [_text((0.0, 0.0), 1.5 * size, str(robot.id), color)],
        }
        entities.append(_entity(f"robot {robot.id}", frame_of(robot.id), **shapes))
    return _update(entities)


def ground(fleet: Fleet) -> str | None:
    """Obstacles and geofence; None where there are none."""
    entities = []
    for each in obstacles_of(fleet):
        if isinstance(each, Circle):
            shape = _cylinder((each.x, each.y), 2 * each.radius, _OBSTACLE_HEIGHT_M, _color(_GREY, 0.6))
            entities.append(_entity(f"obstacle {each.name}", WORLD, cylinders=[shape]))
        else:
            lines = [_line(_LINE_LOOP, each.points, _GREY, 4.0)]
            entities.append(_entity(f"obstacle {each.name}", WORLD, lines=lines))
    fence = fence_of(fleet)
    if fence is not None:
        entities.append(_entity(fence.name, WORLD, lines=[_line(_LINE_LOOP, fence.points, _GREY, 2.0)]))
    return _update(entities) if entities else None


# ---------------------------------------------------------------------- what does


def poses(moment: Moment) -> str:
    """Every robot's frame, and that of the formation, in W."""
    transforms = [
        _TRANSFORM % (frame_of(robot), x, y, sin(heading / 2), cos(heading / 2))
        for robot, x, y, heading, *_ in moment.bodies
    ]
    if moment.places and moment.reference is not None:
        transforms.append(_TRANSFORM % (FORMATION, *moment.reference, 0.0, 1.0))
    return _TRANSFORMS % ",".join(transforms)


def error_of(link: Link, safe_m: float) -> str:
    """How an edge is, one of `EDGE_COLORS`."""
    if link.distance < safe_m:
        return "unsafe"
    error = link.distance - link.wanted  # within a change of mission 0 m may be wanted
    return "holds" if abs(error) <= HOLDS * link.wanted else "too long" if error > 0.0 else "too short"


def edges(moment: Moment, safe_m: float) -> str:
    """The edges by their error, and lines from robots that are not at their places to these."""
    ends: dict[str, list[Vector]] = {name: [] for name in EDGE_COLORS}
    for link in moment.links:
        ends[error_of(link, safe_m)] += (moment.hands[link.i], moment.hands[link.j])
    lines = [
        _line(_LINE_LIST, points, EDGE_COLORS[name], _EDGE_PX[name])
        for name, points in ends.items()
        if points
    ]
    ways = []
    if moment.reference is not None:
        rx, ry = moment.reference
        for robot, error in moment.place_errors.items():
            if error > moment.at_place:
                x, y = moment.places[robot]
                ways += [moment.hands[robot], (rx + x, ry + y)]
    to_places = [_line(_LINE_LIST, ways, _GREY, 1.0)] if ways else []
    return _update([_entity("edges", WORLD, lines=lines), _entity("ways", WORLD, lines=to_places)])


def places(moment: Moment, safe_m: float) -> str:
    """A cross at every place. Seen from the reference point they stand still but while a mission changes."""
    half = _CROSS_SHARE * safe_m
    points: list[Vector] = []
    for x, y in moment.places.values():
        points += ((x - half, y - half), (x + half, y + half), (x - half, y + half), (x + half, y - half))
    lines = [_line(_LINE_LIST, points, _GREY)] if points else []
    return _update([_entity("places", FORMATION, lines=lines)])


def silent(moment: Moment) -> str:
    """Where robots that are not heard are believed to be: the way, its ends as wide as the doubt."""
    cylinders, texts, ways = [], [], []
    color = _color(_SILENT_COLOR, 0.4)
    for robot, row in moment.believed.items():
        here, there = (row.x, row.y), (row.to_x, row.to_y)
        ends = [here] if hypot(there[0] - here[0], there[1] - here[1]) < _DISC_HEIGHT_M else [here, there]
        cylinders += [_cylinder(end, max(2 * row.doubt, 0.1), _DISC_HEIGHT_M, color) for end in ends]
        texts.append(_text(here, 0.3, f"{robot} not heard", color | {"a": 1.0}))
        ways += [here, there]
    lines = [_line(_LINE_LIST, ways, _SILENT_COLOR, 4.0)] if ways else []
    return _update([_entity("not heard", WORLD, cylinders=cylinders, lines=lines, texts=texts)])
