"""What is said to keep robots from their places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import Status
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.causes import Causes, held_by, kept_from
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, Sent, make_fleet, messages, standing

LINE = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=6.0, rate_hz=10.0)


def run(
    *hands: Path,
    fleet: Fleet = LINE,
    reasons: Mapping[int, str] | None = None,
    filtered: Mapping[int, Mapping[str, float]] | None = None,
    silent: int = 0,
) -> Recording:
    """A drive of three whose statuses have these reasons, and counters that grow by so much a second.

    One says nothing in its last 4 s.
    """

    def told(each: Sent) -> Sent:
        received_ns, key, message = each
        if type(message) is not Status:
            return each
        t = (message.time_ns - EPOCH_NS) / 1e9
        counters = tuple(
            (f"filtered.{name}", round(rate * t))
            for name, rate in (filtered or {}).get(message.robot, {}).items()
        )
        reason = (reasons or {}).get(message.robot, "")
        return received_ns, key, message._replace(reason=reason, counters=counters)

    bodies = [body(hand, robot.hand_offset_m) for hand, robot in zip(hands, fleet.robots, strict=True)]
    sent = [told(each) for each in messages(fleet, bodies)]
    return recorded(
        fleet,
        [
            each
            for each in sent
            if not (type(each[2]) is Status and each[2].robot == silent and each[0] > EPOCH_NS + 2 * 10**9)
        ],
    )


def causes(recording: Recording, robot: int) -> list[str]:
    a = analyse(recording, resolve(recording.fleet))
    far = np.hypot(*np.moveaxis(a.hands[-1] - a.desired[-1], 1, 0)) > 0.25
    return Causes(recording, a, far).of(recording.ids.index(robot))


FAR = standing(0, -3), standing(1, 0), standing(2, 0)


def test_its_own_words() -> None:
    assert causes(run(*FAR, reasons={1: "without robot 6 (75.0 s)"}), 1) == ["without robot 6 (75.0 s)"]
    assert causes(run(*FAR), 1) == []


def test_its_own_words_count_for_a_while() -> None:
    """They may be why it is where it is."""
    base = run(*FAR)
    one = base.robots[1]

    def until(t: float) -> list[str]:
        reasons = ["on its way round post 4" if each <= t else "" for each in one.status.t]
        data = replace(one, status=replace(one.status, reasons=reasons))
        return causes(replace(base, robots={**base.robots, 1: data}), 1)

    assert until(4.1) == ["on its way round post 4 until 4.0 s"]
    assert until(0.9) == []


def test_what_it_waited_for_before_the_drive_keeps_it_from_nothing() -> None:
    base = run(*FAR)
    one = base.robots[1]
    times = one.status.t - one.status.t[0] - 1.0
    reasons = ["for the epoch" if t < 0.0 else "" for t in times]
    data = replace(one, status=replace(one.status, t=times, reasons=reasons))
    recording = replace(base, robots={**base.robots, 1: data})
    a = analyse(recording, resolve(recording.fleet))
    far = np.array([robot == 1 for robot in recording.ids])
    early = Causes(recording, a, far, int(np.searchsorted(a.grid, 0.5)))
    assert early.of(recording.ids.index(1)) == []


def test_whom_the_safety_filter_kept_it_from() -> None:
    """In more than a tenth of the ticks of the last 2 s; its limits are named by what sets them."""
    filtered = {1: {"any": 10, "robot 3": 8, "post 4": 9, "speed": 5, "robot 2": 0.5}}
    recording = run(*FAR, filtered=filtered)
    assert held_by(recording, 1, 4.0, 6.0) == ["post 4", "robot 3", "speed"]
    assert kept_from(recording, 1, 4.0, 6.0) == ["post 4", "robot 3"]
    assert causes(recording, 1) == ["held up by post 4 and robot 3", "at the limit of control.max_speed_mps"]


def test_who_is_named_in_its_own_words_is_not_said_twice() -> None:
    recording = run(*FAR, filtered={1: {"robot 3": 8}}, reasons={1: "on its way round robot 3"})
    assert causes(recording, 1) == ["on its way round robot 3"]
    recording = run(*FAR, filtered={1: {"speed": 8}}, reasons={1: "held back by its limit of speed"})
    assert causes(recording, 1) == ["held back by its limit of speed"]
    recording = run(*FAR, filtered={1: {"robot 3": 8}}, reasons={1: "on its way round robot 30"})
    assert causes(recording, 1) == ["on its way round robot 30", "held up by robot 3"]


def test_how_long_whom_it_names_is_silent_is_added() -> None:
    reasons = {1: "held up by robot 3"}
    assert causes(run(*FAR, reasons=reasons), 1) == ["held up by robot 3"]
    assert causes(run(*FAR, reasons=reasons, silent=3), 1) == ["held up by robot 3 (silent for 4 s)"]


def test_an_agent_that_is_silent_itself() -> None:
    """As one that is frozen: before what its neighbours may have to do with it."""
    assert causes(run(*FAR, silent=1), 1) == ["its agent has said nothing for 4 s"]
    ways = standing(0, -0.3), standing(1, -0.3), standing(2, 0)
    said = "held back by robot 2 (its agent has said nothing for 4 s)"
    assert causes(run(*ways, silent=2), 1) == [said]


def test_a_robot_that_stands_before_it_and_how_long_that_is_silent() -> None:
    """Robot 3 stands where robot 1 has to go, they share no edge; robot 2, behind, is as near."""
    ways = standing(0, -3), standing(0, -3.3), standing(0, -2.6)
    assert causes(run(*ways), 1) == ["held up by robot 3"]
    assert causes(run(*ways, silent=3), 1) == ["held up by robot 3 (silent for 4 s)"]
    off = replace(LINE, avoidance=replace(LINE.avoidance, enabled=False))
    assert causes(run(*ways, fleet=off), 1) == [], "nothing pushes them apart"


@pytest.mark.parametrize(("speed_mps", "said"), [(3.0, True), (1.25, True), (1.1, False)])
def test_a_place_that_is_hard_to_catch_up_with(speed_mps: float, said: bool) -> None:
    base = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=6.0, velocity=(speed_mps, 0.0))
    expected = [f"places move at {speed_mps:.2f} m/s and the limit is control.max_speed_mps = 1.5"]
    assert causes(run(*FAR, fleet=base), 1) == (expected if said else [])


@pytest.mark.parametrize(
    ("speed_mps", "said"),
    [
        (0.45, ["as fast as control.max_speed_mps = 0.5 allows"]),
        (0.2, []),
        (-0.45, []),
    ],
)
def test_a_robot_that_comes_as_fast_as_it_may(speed_mps: float, said: list[str]) -> None:
    fleet = replace(LINE, control=replace(LINE.control, max_speed_mps=0.5))

    def hand(t: float) -> tuple[float, float]:
        return -9.0 + speed_mps * t, 0.0

    assert causes(run(hand, *FAR[1:], fleet=fleet), 1) == said


def test_a_robot_that_nothing_keeps_is_held_back_by_whom_it_shares_an_edge_with() -> None:
    ways = standing(0, -0.3), standing(1, -0.3), standing(2, 0)
    recording = run(*ways, reasons={2: "on its way round post 7"})
    assert causes(recording, 1) == ["held back by robot 2 (on its way round post 7)"]


def test_a_shape_at_rest_is_named_with_all_that_are_in_it() -> None:
    """Both have come in from the other side and stand where the forces are in balance: found by driving."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=6.0)
    fleet = replace(fleet, control=replace(fleet.control, kp=1.0))
    recording = run(standing(0.864, 0), standing(0.136, 0), fleet=fleet)
    shape = "robots 1 and 2 are at rest in another shape"
    assert causes(recording, 1) == causes(recording, 2) == [shape]
