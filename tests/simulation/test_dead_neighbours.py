"""A robot drives on to its place when all its edge neighbours have died, if it still hears another robot."""

from __future__ import annotations

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.simulate.simulation import Simulation

NS_PER_S = 1_000_000_000


def column(edges: str, dead: tuple[int, ...], spacing: float, speed: float) -> Fleet:
    """Five robots one behind the other, of which some die after 3 s."""
    robots = "".join(f"[[robot]]\nid = {k}\nx_m = {-spacing * (k - 1)}\ny_m = 0\n" for k in range(1, 6))
    rules = "".join(f'[[faults.rule]]\nrobot = {k}\nkill = "both"\nat = 3\n' for k in dead)
    places = ", ".join(f"[{-spacing * k}, 0.0]" for k in range(5))
    text = f"""
[fleet]
name = "column"
rate_hz = 20
duration_s = 25
[formation]
edges = {edges}
safe_distance_m = 0.22
offsets = [{places}]
[trajectory]
kind = "line"
velocity_mps = [{speed}, 0.0]
{robots}{rules}"""
    return resolved(parse_fleet(text, source="column.toml"))


COLUMN = "[[1, 2], [2, 3], [3, 4], [4, 5]]"
HUB = "[[3, 1], [3, 2], [3, 4], [3, 5]]"


@pytest.mark.parametrize("spacing", [0.8, 1.2, 2.0])
@pytest.mark.parametrize("speed", [0.2, 0.6])
@pytest.mark.parametrize(("edges", "dead"), [(COLUMN, (2,)), (COLUMN, (4,)), (COLUMN, (2, 4)), (HUB, (3,))])
def test_who_has_only_dead_neighbours_goes_on(
    edges: str, dead: tuple[int, ...], spacing: float, speed: float
) -> None:
    run = Simulation(column(edges, dead, spacing, speed))
    assert run.start(25 * NS_PER_S)
    run.run_until(run.epoch_ns + 24 * NS_PER_S)
    states = {
        agent.robot: (agent.state.value, agent.reason) for agent in run.agents if agent.robot not in dead
    }
    assert {state for state, _ in states.values()} <= {"running", "degraded"}, states


def test_who_hears_nobody_at_all_holds() -> None:
    run = Simulation(column(COLUMN, (1, 2, 3, 4), 1.2, 0.2))
    assert run.start(25 * NS_PER_S)
    run.run_until(run.epoch_ns + 24 * NS_PER_S)
    assert run.agents[4].state.value == "holding"
    assert "hears none of its neighbours" in run.agents[4].reason


def test_two_groups_that_share_no_edge_drive_side_by_side() -> None:
    run = Simulation(column("[[1, 2], [3, 4], [4, 5]]", (), 1.0, 0.3))
    assert run.start(25 * NS_PER_S)
    run.run_until(run.epoch_ns + 20 * NS_PER_S)
    assert {agent.state.value for agent in run.agents} == {"running"}
