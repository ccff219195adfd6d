"""Bodies that were not on the field, by what operators said and what was heard since."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Mission, Removed, Status
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.analysis.removals import carried_off
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, make_fleet, messages, standing

FLEET = make_fleet([(0.0, 0.0), (1.0, 0.0), (0.5, 1.0)], [(1, 2)], duration_s=8.0, rate_hz=20.0)
NAME = FLEET.fleet.name


def ns(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def removal(version: int, *removed: tuple[int, float]) -> Mission:
    rows = tuple(Removed(robot, ns(t)) for robot, t in removed)
    at_ns = max(time_ns for _, time_ns in rows)
    places = ((1, 0.0, 0.0), (2, 1.0, 0.0))
    return Mission(version, at_ns, EPOCH_NS, 8 * 10**9, "", robots=places, edges=((1, 2, 1.0),), removed=rows)


def run(missions: list[Mission], silent: tuple[float, float]) -> Recording:
    """Robot 3 stands 0.1 m beside robot 1 all the time; its agent says nothing meanwhile."""
    places = [standing(0.0, 0.0), standing(1.0, 0.0), standing(0.0, 0.1)]

    def all_of_it() -> Iterator[Sent]:
        for received_ns, key, message in messages(FLEET, places):
            about = type(message) is Status and message.robot == 3
            if not (about and silent[0] <= (received_ns - EPOCH_NS) / 1e9 < silent[1]):
                yield received_ns, key, message
        for mission in missions:
            yield mission.time_ns, key_expressions.mission(NAME), mission

    data = RunData(FLEET)
    for each in all_of_it():
        data.feed(*each)
    return data.recording()


def spans(recording: Recording, robot: int) -> list[tuple[float, float]]:
    """From when to when a body was away, s."""
    flags = carried_off(recording, recording.grid)[:, recording.ids.index(robot)]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    times = [*recording.grid.tolist(), np.inf]
    return [(times[k], times[j]) for k, j in edges.reshape(-1, 2).tolist()]


def test_where_nobody_was_removed_all_are_there() -> None:
    assert not carried_off(run([], (2.0, 9.0)), np.arange(3.0)).any()


def test_a_body_is_away_until_its_robot_says_something() -> None:
    recording = run([removal(2, (3, 4.0))], (2.0, 6.0))
    ((start_s, end_s),) = spans(recording, 3)
    assert (start_s, round(end_s, 1)) == (4.0, 6.0)
    assert spans(recording, 1) == spans(recording, 2) == []
    ((start_s, end_s),) = spans(run([removal(2, (3, 4.0))], (2.0, 9.0)), 3)
    assert (start_s, end_s) == (4.0, np.inf)


def test_one_that_is_removed_twice_is_away_twice() -> None:
    back = Status(3, 1, ns(5.0), "standby", "", "", 2, 0, (), (), (), ())
    missions = [removal(2, (3, 4.0)), removal(3, (3, 6.0))]
    recording = run(missions, (2.0, 9.0))
    assert [start_s for start_s, _ in spans(recording, 3)] == [4.0]
    data = RunData(FLEET)
    for received_ns, key, message in messages(FLEET, [standing(0.0, 0.0)] * 3):
        if not (type(message) is Status and message.robot == 3 and message.time_ns > ns(2.0)):
            data.feed(received_ns, key, message)
    for mission in missions:
        data.feed(mission.time_ns, key_expressions.mission(NAME), mission)
    data.feed(ns(5.0), key_expressions.status(NAME, 3), back)
    assert spans(data.recording(), 3) == [(4.0, 5.0), (6.0, np.inf)]


def test_who_is_away_is_near_nobody() -> None:
    there = analyse(run([], (2.0, 9.0)), resolve(FLEET))
    assert there.closest is not None
    assert there.closest.pair == (1, 3)
    recording = run([removal(2, (3, 1.0))], (0.5, 9.0))
    a = analyse(recording, resolve(FLEET))
    row = int(np.searchsorted(a.grid, 1.0))
    assert np.isfinite(a.hands[:row, 2]).all()
    assert np.isnan(a.hands[row:, 2]).all()
    assert np.isfinite(a.hands[:, :2]).all()
