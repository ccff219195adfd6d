"""Robots drive through fields of posts, however long their edges are, and take places beside posts."""

from __future__ import annotations

import random
from math import cos, dist, pi, sin

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.sweep.run import drive
from handfast.deploy.verdict.run_result import RunResult

SAFE_M = 0.22
POST_M = 0.1


def field(seed: int, edge_m: float, robots: int = 3, posts: int = 4) -> Fleet:
    """Robots in a ring of edges, which cross a field of posts to the other side of it."""
    draw = random.Random(seed)
    radius = edge_m / (2.0 * sin(pi / robots))
    ring = [(radius * cos(2.0 * pi * k / robots), radius * sin(2.0 * pi * k / robots)) for k in range(robots)]
    across = 2.5 * radius + 4.0
    edges = [[k + 1, (k + 1) % robots + 1] for k in range(robots)]
    clear = [(x + dx, y) for x, y in ring for dx in (0.0, across)]
    placed: list[tuple[float, float]] = []
    while len(placed) < posts:
        post = draw.uniform(radius, across - radius), draw.uniform(-radius - 0.5, radius + 0.5)
        room = 2.0 * POST_M + 4.0 * SAFE_M
        if all(dist(post, each) > room for each in (*clear, *placed)):
            placed.append(post)
    rows = "".join(f"[[robot]]\nid = {k + 1}\nx_m = {x}\ny_m = {y}\n" for k, (x, y) in enumerate(ring))
    rows += "".join(f"[[obstacle]]\ncentre_m = [{x}, {y}]\nradius_m = {POST_M}\n" for x, y in placed)
    places = ", ".join(f"[{x + across}, {y}]" for x, y in ring)
    text = f"""
[fleet]
name = "posts"
rate_hz = 20
duration_s = {30.0 + 2.0 * across}
[formation]
edges = {edges}
safe_distance_m = {SAFE_M}
offsets = [{places}]
{rows}"""
    return resolved(parse_fleet(text, source="posts.toml"))


def expect_crossed(fleet: Fleet) -> None:
    result = RunResult(drive(fleet))
    assert not result.reasons, result.reasons
    closest = result.analysis.closest
    assert closest is None or closest.distance_m >= SAFE_M


@pytest.mark.parametrize("edge_m", [1.0, 2.0, 4.0, 8.0])
def test_a_field_of_posts_is_crossed_however_long_edges_are(edge_m: float) -> None:
    expect_crossed(field(0, edge_m))


@pytest.mark.long
@pytest.mark.parametrize("edge_m", [1.0, 2.0, 4.0, 8.0])
@pytest.mark.parametrize("seed", range(1, 101))
def test_a_hundred_fields_are_crossed(seed: int, edge_m: float) -> None:
    expect_crossed(field(seed, edge_m))
