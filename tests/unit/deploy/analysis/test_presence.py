"""When processes were up, and whom nothing commanded meanwhile."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Event, PlantState
from handfast.deploy.analysis.presence import Down, downs, uncommanded, untold
from handfast.deploy.recording.recording import Recording
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, make_fleet, messages, standing

FLEET = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=8.0, rate_hz=10.0)


def ns(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def event(t: float, robot: int, role: str, what: str) -> Event:
    return Event(robot, round(t * 1000), ns(t), role, what, "rule")


def run(*events: Event, lacks: tuple[float, float] = (-1.0, -1.0)) -> Recording:
    """Two rovers that stand; of robot 2 no pose came in a time."""
    rovers = tuple(replace(robot, plant="mavlink") for robot in FLEET.robots)
    fleet = replace(FLEET, robots=rovers)
    poses = [body(standing(0.0, 0.0), 0.1), body(standing(1.0, 0.0), 0.1)]
    sent = (
        each
        for each in messages(FLEET, poses)
        if not (
            type(each[2]) is PlantState
            and each[2].robot == 2
            and lacks[0] < (each[0] - ns(0)) / 1e9 < lacks[1]
        )
    )
    more = [(each.time_ns, key_expressions.events(FLEET.fleet.name), each) for each in events]
    return replace(recorded(FLEET, [*sent, *more]), fleet=fleet)


def test_what_was_killed_or_paused_is_down_until_it_goes_on() -> None:
    recording = run(
        event(1.0, 2, "agent", "stop"),
        event(2.0, 2, "agent", "kill"),
        event(3.0, 2, "agent", "start"),
        event(4.0, 2, "plant", "kill"),
    )
    assert downs(recording, 2, "agent") == [Down(1.0, 3.0, "stop")]
    assert downs(recording, 2, "plant") == [Down(4.0, inf, "kill")]
    assert downs(recording, 1, "agent") == []


def test_nothing_commands_a_vehicle_until_its_new_bridge_knows_where_it_is() -> None:
    killed, again = event(2.0, 2, "plant", "kill"), event(4.0, 2, "plant", "start")
    recording = run(killed, again, lacks=(2.05, 5.95))
    ((since_s, until_s),) = untold(recording, 2)
    assert (since_s, round(until_s, 1)) == (2.0, 6.0)
    grid = np.array([1.9, 2.1, 5.9, 6.1])
    rolling, helpless = uncommanded(recording, grid)
    assert (
        rolling.tolist()
        == helpless.tolist()
        == [[False, False], [False, True], [False, True], [False, False]]
    )
    for_good = uncommanded(run(killed, lacks=(2.05, 99.0)), grid)
    assert for_good.rolling[:, 1].tolist() == [False, True, True, True]


def test_who_has_no_agent_can_do_nothing_and_does_not_roll() -> None:
    rolling, helpless = uncommanded(run(event(2.0, 1, "agent", "kill")), np.array([1.9, 2.1]))
    assert not rolling.any()
    assert helpless.tolist() == [[False, False], [True, False]]


def test_a_body_that_stands_without_its_plant_does_not_roll() -> None:
    recording = replace(run(event(2.0, 1, "plant", "kill")), fleet=FLEET)
    assert not uncommanded(recording, recording.grid).helpless.any()
