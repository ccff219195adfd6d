"""What Foxglove's Plot panel draws: the fleet in numbers (PURE)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from handfast.agent.messages.types import Status
from handfast.deploy.recording.foxglove.moment import Moment

_PLOTS: Final = '{%s,"robots":[%s],"edges":[%s]}'
_ROBOT: Final = "{%s}"
_EDGE: Final = '{"label":"%d-%d","error_m":%.4f}'


def plots(moment: Moment, statuses: Mapping[int, Status], safe_m: float) -> str:
    """The content of the topic: units as in its schema, what is not known left out."""
    errors = [(link.i, link.j, link.distance - link.wanted) for link in moment.links if link.counts]
    head = f'"safe_distance_m":{safe_m:.4f}'
    if moment.least is not None:
        head += f',"least_distance_m":{moment.least[0]:.4f}'
    if moment.place_errors:
        head += f',"worst_place_error_m":{max(moment.place_errors.values()):.4f}'
    if errors:
        head += f',"worst_edge_error_m":{max(abs(error) for _, _, error in errors):.4f}'
    robots = []
    for body in moment.bodies:
        robot = body.robot
        row = f'"label":"robot {robot}","id":{robot},"speed_m_s":{body.speed:.3f}'
        place_error, nearest = moment.place_errors.get(robot), moment.nearest.get(robot)
        if place_error is not None:
            row += f',"place_error_m":{place_error:.4f}'
        if nearest is not None:
            row += f',"nearest_m":{nearest:.4f}'
        status = statuses.get(robot)
        if status is not None:
            if status.neighbours:
                row += f',"age_ms":{max(each[1] for each in status.neighbours) / 1e3:.1f}'
            if status.tick_us:
                row += f',"tick_us":{max(status.tick_us)}'
        robots.append(row)
    edges = [_EDGE % error for error in errors]
    return _PLOTS % (head, ",".join([_ROBOT % row for row in robots]), ",".join(edges))
