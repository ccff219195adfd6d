"""What was wanted over time, who could follow, and what a run with changes of mission is judged by."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import plan_of
from handfast.agent.formation.reference import Reference
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Event, Message, Mission, Resume, Status, Stop
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.analysis.presence import downs
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, make_fleet, messages, standing

ROBOTS = ((1, 0.0, 0.0), (2, 1.0, 0.0), (3, 0.5, 1.0))
EDGES = ((1, 2, 1.0), (1, 3, 1.25**0.5), (2, 3, 1.25**0.5))


def ns(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def fleet_of_two() -> Fleet:
    """Robots 1 and 2 drive, robot 3 is in reserve."""
    three = make_fleet([(x, y) for _, x, y in ROBOTS], [(1, 2)], duration_s=8.0, rate_hz=20.0)
    robots = (*three.robots[:2], replace(three.robots[2], reserve=True))
    formation = replace(three.formation, offsets=tuple((x, y) for _, x, y in ROBOTS[:2]))
    return replace(three, robots=robots, formation=formation)


FLEET = fleet_of_two()
NAME = FLEET.fleet.name
FIRST = Mission(1, ns(-0.5), EPOCH_NS, 8 * 10**9, "")
JOIN = Mission(
    2, ns(1.0), EPOCH_NS, 8 * 10**9, "", ns(2.0), 10**9, "robot 3 joins", robots=ROBOTS, edges=EDGES
)
LEAVE = JOIN._replace(
    version=3, time_ns=ns(4.0), from_ns=ns(5.0), note="robot 1 leaves", robots=ROBOTS[1:], edges=EDGES[2:]
)


def run(
    fleet: Fleet, missions: Iterable[Mission], late_s: float = 0.0, extra: Iterable[Sent] = ()
) -> Recording:
    """Hand points are where they should be, those of robot 3 `late_s` later; one in reserve waits far off."""
    geometry = resolve(fleet)
    reference = Reference(fleet, geometry)
    plans = [plan_of(mission, fleet, geometry) for mission in missions]
    data = RunData(fleet)
    places: dict[tuple[int, int], tuple[float, float]] = {}

    def place(robot: int, t: float) -> tuple[float, float]:
        while plans and plans[0].mission.time_ns <= ns(t):
            reference.take(plans.pop(0))
        motion = reference.motion(robot, ns(t - late_s) if robot == 3 else ns(t))
        return (motion[0], motion[1]) if motion is not None else (9.0, float(robot))

    for received, key, message in messages(fleet, [lambda t: (0.0, 0.0, 0.0)] * 3):
        if type(message) is Mission:
            continue
        if hasattr(message, "heading"):
            robot, t = message.robot, (message.time_ns - EPOCH_NS) / 1e9
            x, y = places.setdefault((robot, message.time_ns), place(robot, t))
            message = message._replace(x=x - 0.1, y=y)
        data.feed(received, key, message)
    for mission in missions:
        data.feed(mission.time_ns + 1, key_expressions.mission(fleet.fleet.name), mission)
    for each in extra:
        data.feed(*each)
    return data.recording()


def analysed(recording: Recording) -> Analysis:
    return analyse(recording, resolve(recording.fleet))


def row(a: Analysis, t: float) -> int:
    return int(np.searchsorted(a.grid, t - 1e-9))


def test_a_robot_in_reserve_has_no_place() -> None:
    a = analysed(run(FLEET, [FIRST]))
    assert a.ids == (1, 2, 3)
    assert np.isnan(a.desired[:, 2]).all()
    assert a.desired[-1, :2].tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert (a.edges.tolist(), a.settling_s, a.changes) == ([[0, 1]], 0.0, ())
    assert a.wanted.tolist() == [[1.0]] * len(a.grid)


def test_what_is_wanted_follows_the_missions() -> None:
    a = analysed(run(FLEET, [FIRST, JOIN, LEAVE]))
    edges = {tuple(a.ids[i] for i in edge): column for column, edge in enumerate(a.edges.tolist())}
    assert list(edges) == [(1, 2), (1, 3), (2, 3)]

    def in_force(t: float) -> list[tuple[int, int]]:
        return [edge for edge, column in edges.items() if np.isfinite(a.wanted[row(a, t), column])]

    def whole(t: float) -> list[tuple[int, int]]:
        return [edge for edge, column in edges.items() if a.counts[row(a, t), column]]

    assert in_force(1.9) == whole(1.9) == [(1, 2)]
    assert in_force(2.5) == list(edges)
    assert whole(2.5) == [(1, 2)]
    assert in_force(4.5) == whole(4.5) == list(edges)
    assert in_force(7.0) == whole(7.0) == [(2, 3)]
    assert np.isnan(a.desired[row(a, 1.9), 2]).all()
    assert a.desired[row(a, 4.0), 2].tolist() == [0.5, 1.0]
    assert np.isnan(a.desired[row(a, 7.0), 0]).all()
    assert a.mission_version == 3


def test_a_change_is_settled_after_its_last_edge_was_off() -> None:
    def changes(late_s: float) -> list[dict[str, Any]]:
        recording = run(FLEET, [FIRST, JOIN, LEAVE], late_s)
        found = RunResult(recording).metrics
        assert found["final_distance_error_m"] == found["final_tracking_error_m"] == 0.0
        return list(found["changes"])

    prompt, late = changes(0.0), changes(1.5)
    assert [(each["t_s"], each["version"], each["note"]) for each in prompt] == [
        (2.0, 2, "robot 3 joins"), (5.0, 3, "robot 1 leaves"),
    ]  # fmt: skip
    assert [each["settled_after_s"] for each in prompt] == [0.0, 0.0]
    # For 1.5 s robot 3 stays where it was, far off; for 1 s its edges are only coming.
    assert [each["settled_after_s"] for each in late] == [pytest.approx(1.45), 0.0]


def test_a_change_that_never_settles_says_so() -> None:
    a = analysed(run(FLEET, [FIRST, JOIN, LEAVE], 4.0))
    assert [settled.after_s for settled in a.changes] == [None, pytest.approx(0.95)]


def test_only_missions_that_can_be_driven_and_are_newer_count() -> None:
    lost = JOIN._replace(version=9, robots=((77, 0.0, 0.0),), edges=())
    old = LEAVE._replace(version=1, time_ns=ns(1.5))
    recording = run(FLEET, [FIRST, JOIN])
    for mission in (old, lost):
        recording = replace(recording, missions=(*recording.missions, mission))
    a = analysed(recording)
    assert a.mission_version == 2
    assert [settled.change.version for settled in a.changes] == [2]


def test_a_mission_holds_from_when_it_was_known() -> None:
    """The last one says that it held before robot 3 joined, but came 2 s after."""
    late = LEAVE._replace(from_ns=ns(1.5), robots=ROBOTS[:2], edges=EDGES[:1])
    a = analysed(run(FLEET, [FIRST, JOIN, late]))
    assert np.isfinite(a.desired[row(a, 3.5), 2]).all()
    assert np.isnan(a.desired[row(a, 4.5), 2]).all()


def test_a_new_epoch_before_the_drive_is_no_change() -> None:
    again = FIRST._replace(version=2, time_ns=ns(-0.4))
    a = analysed(run(FLEET, [FIRST, again]))
    assert (a.changes, a.mission_version, a.settling_s) == ((), 2, 0.0)


def test_missions_and_stops_that_are_said_again_are_kept_once() -> None:
    said: list[Sent] = []
    for t in (1.5, 120.0):  # agents say them to each other, with the stamps that they came with
        said.append((ns(t), key_expressions.mission(NAME), JOIN))
        said.append((ns(t), key_expressions.stop(NAME), Stop(4, ns(1.2), "now")))
    recording = run(FLEET, [FIRST, JOIN], extra=said)
    assert [mission.version for mission in recording.missions] == [1, 2]
    assert [each.time_ns for each in recording.stops] == [ns(1.2)]
    assert recording.foreign == 0
    ahead = JOIN._replace(version=5, time_ns=ns(3600.0))  # nobody's clock
    recording = run(FLEET, [FIRST, JOIN], extra=[(ns(1.5), key_expressions.mission(NAME), ahead)])
    assert ([mission.version for mission in recording.missions], recording.foreign) == ([1, 2], 1)


# --- who could follow ---------------------------------------------------------------------------


def event(t: float, what: str, role: str = "agent") -> Sent:
    return ns(t), key_expressions.events(NAME), Event(2, round(t * 1e3), ns(t), role, what, "rule")


def test_edges_of_robots_that_cannot_follow_do_not_count() -> None:
    def changed(message: Message) -> Message:
        t = (message.time_ns - EPOCH_NS) / 1e9
        if type(message) is Status and message.robot == 2 and 1.9 < t < 4.0:
            return message._replace(state="released")
        return message

    stops: list[Sent] = [
        (ns(7.0), key_expressions.stop(NAME), Stop(1, ns(7.0), "now")),
        (ns(7.5), key_expressions.resume(NAME), Resume(2, ns(7.5), ())),
    ]
    recording = run(FLEET, [FIRST], extra=[event(5.0, "kill"), event(6.0, "start"), *stops])
    data = RunData(FLEET)
    for received, key, message in messages(FLEET, [lambda t: (0.0, 0.0, 0.0)] * 3):
        data.feed(received, key, changed(message))
    released = data.recording()
    robots = recording.robots | {2: replace(recording.robots[2], status=released.robots[2].status)}
    a = analysed(replace(recording, robots=robots))
    times = [0.5, 2.5, 4.5, 5.5, 6.5, 7.25, 7.75]
    assert [bool(a.counts[row(a, t), 0]) for t in times] == [True, False, True, False, True, False, True]
    assert a.away[:, 0].tolist() == ((a.grid > 7.0) & (a.grid <= 7.5)).tolist()


def test_a_body_stands_while_its_plant_is_paused_where_it_is_found_afterwards() -> None:
    """From 2 s to 4 s no pose of robot 2 came, and then it is 1 m further on. Else its place is not known."""

    def hands(*events: Sent) -> dict[float, float]:
        data = RunData(FLEET)
        paths = [standing(0, 0), lambda t: (1.0 if t < 3.0 else 2.0, 0.0, 0.0), standing(5, 5)]
        for received, key, message in messages(FLEET, paths):
            t = (message.time_ns - EPOCH_NS) / 1e9
            if key != key_expressions.plant_state(NAME, 2) or not 2.0 < t < 4.0:
                data.feed(received, key, message)
        for each in events:
            data.feed(*each)
        a = analysed(data.recording())
        return {t: round(float(a.hands[row(a, t), 1, 0]) - 0.1, 6) for t in (2.0, 2.25, 2.5, 3.0, 4.0)}

    assert str(hands()) == "{2.0: 1.0, 2.25: nan, 2.5: nan, 3.0: nan, 4.0: 2.0}"
    paused = event(2.0, "stop", "plant"), event(3.97, "continue", "plant")
    assert hands(*paused) == {2.0: 1.0, 2.25: 1.5, 2.5: 2.0, 3.0: 2.0, 4.0: 2.0}
    assert np.isnan(hands(paused[0])[3.0])  # it is not known when it came back


def test_when_processes_were_down() -> None:
    said = [event(1.0, "stop"), event(2.0, "kill"), event(3.0, "start"), event(3.0, "stop"),
            event(4.0, "continue"), event(6.0, "kill"), event(5.0, "kill", "plant")]  # fmt: skip
    recording = run(FLEET, [FIRST], extra=said)
    spans = [(down.start_s, down.end_s, down.what) for down in downs(recording, 2, "agent")]
    assert spans == [(1.0, 3.0, "stop"), (3.0, 4.0, "stop"), (6.0, float("inf"), "kill")]
    assert [down.start_s for down in downs(recording, 2, "plant")] == [5.0]
    assert downs(recording, 1, "agent") == []


def test_the_closest_pair_goes_by_the_edges_of_the_time() -> None:
    """Robots 1 and 3 share an edge until 5.5 s; then robot 1 passes by."""
    fine = replace(FLEET, fleet=replace(FLEET.fleet, rate_hz=50.0))  # between two times it is nowhere
    recording = run(fine, [FIRST, JOIN, LEAVE])
    body = recording.robots[1].plant
    body["x"][(body.t > 6.99) & (body.t < 7.01)] = 0.6
    a = analysed(recording)
    assert a.with_edge.closest is not None
    assert a.with_edge.closest.distance_m == pytest.approx(1.0)
    assert a.without_edge.closest is not None
    assert a.without_edge.closest == (pytest.approx(0.2), pytest.approx(7.0), (1, 3))
