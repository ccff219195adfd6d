"""Random starts of a fleet, the same for the same seed: what a law is sampled with."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, pi, sin

import numpy as np

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.formation.trajectory import make_trajectory

ATTEMPTS_MAX = 1000  # per robot: a square that is too full is an error, not an endless search


def random_fleet(
    base: Fleet, seed: int, side_m: float = 4.0, gap_m: float = 0.3, *, assign: bool = True
) -> Fleet:
    """`base` with other starts, resolved: robots at rest, their formation turned at random.

    Hand points are uniform in a square of `side_m` round the start of the trajectory, each at least
    `gap_m` from the others; headings are uniform. `assign` gives every robot the slot near it.

    Raises:
        ValueError: the square has no room for so many robots.
    """
    generator = np.random.default_rng([seed, len(base.robots)])
    geometry = resolve(base)
    angle = generator.uniform(-pi, pi)
    turn = np.array(((cos(angle), -sin(angle)), (sin(angle), cos(angle))))
    centre = make_trajectory(base.trajectory).at(0.0)[:2]
    hands: list[tuple[float, float]] = []
    for _ in base.robots:
        for _ in range(ATTEMPTS_MAX):
            x, y = generator.uniform(-0.5 * side_m, 0.5 * side_m, 2).tolist()
            if all(hypot(x - other_x, y - other_y) >= gap_m for other_x, other_y in hands):
                hands.append((x, y))
                break
        else:
            raise ValueError(
                f"no room for {len(base.robots)} robots {gap_m} m apart in a square of {side_m} m"
            )
    robots = []
    for robot, (x, y) in zip(base.robots, hands, strict=True):
        heading = generator.uniform(-pi, pi)
        robots.append(
            replace(
                robot,
                x_m=centre[0] + x - robot.hand_offset_m * cos(heading),
                y_m=centre[1] + y - robot.hand_offset_m * sin(heading),
                heading_rad=heading,
            )
        )
    ids = geometry.ids
    formation = replace(
        base.formation,
        offsets=tuple((float(x), float(y)) for x, y in geometry.offsets @ turn.T),
        edges=tuple((ids[i], ids[j]) for i, j in geometry.edges.tolist()),
        distance_m=tuple(geometry.distances.tolist()),
        assign=assign,
    )
    section = replace(base.fleet, seed=seed)
    return resolved(replace(base, fleet=section, formation=formation, robots=tuple(robots)))
