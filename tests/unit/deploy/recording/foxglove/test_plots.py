"""Numbers for curves, and none for what is not known."""

from __future__ import annotations

import json

from handfast.agent.messages.types import Status
from handfast.deploy.recording.foxglove.moment import Body, Link, Moment
from handfast.deploy.recording.foxglove.plots import plots

BODIES = [Body(robot, 0.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0), 0.25, 0, 0) for robot in (1, 2)]
HANDS = {1: (0.0, 0.0), 2: (1.5, 0.0)}
LINKS = [Link(1, 2, 1.5, 1.0, True), Link(1, 3, 9.0, 1.0, False), Link(2, 3, 0.7, 1.0, True)]
MOMENT = Moment(BODIES, HANDS, LINKS, (0.0, 0.0), {}, {1: 0.1, 2: 0.4}, 0.25, {1: 1.5}, (1.5, 1, 2), {}, {})


def test_all_that_is_known_is_there() -> None:
    neighbours = ((2, 3_000, 0, 0, 0, 0), (3, 21_500, 0, 0, 0, 0))
    status = Status(1, 0, 0, "running", "", "", 1, 0, neighbours, (90, 250, 80), (), ())
    assert json.loads(plots(MOMENT, {1: status}, 0.22)) == {
        "safe_distance_m": 0.22, "least_distance_m": 1.5, "worst_place_error_m": 0.4,
        "worst_edge_error_m": 0.5,
        "robots": [
            {
                "label": "robot 1", "id": 1, "speed_m_s": 0.25, "place_error_m": 0.1, "nearest_m": 1.5,
                "age_ms": 21.5, "tick_us": 250,
            },
            {"label": "robot 2", "id": 2, "speed_m_s": 0.25, "place_error_m": 0.4},
        ],
        "edges": [{"label": "1-2", "error_m": 0.5}, {"label": "2-3", "error_m": -0.3}],
    }  # fmt: skip


def test_a_robot_alone_has_no_distances() -> None:
    alone = MOMENT._replace(bodies=BODIES[:1], links=[], place_errors={}, nearest={}, least=None)
    status = Status(1, 0, 0, "running", "", "", 1, 0, (), (), (), ())
    assert json.loads(plots(alone, {1: status}, 0.22)) == {
        "safe_distance_m": 0.22,
        "robots": [{"label": "robot 1", "id": 1, "speed_m_s": 0.25}],
        "edges": [],
    }
