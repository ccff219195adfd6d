"""What is said to keep robots from their places."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import Status
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.tracking import Tracking, held_by, kept_from
from tests.unit.deploy.judged_run import body, recorded
from tests.unit.deploy.synthetic_run import EPOCH_NS, Path, Sent, make_fleet, messages, standing

LINE = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=6.0, rate_hz=10.0)
FAR = standing(0, -3), standing(1, 0), standing(2, 0)
BOTH_FAR = standing(0, -0.3), standing(1, -0.3), standing(2, 0)


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
    late_ns = EPOCH_NS + 2 * 10**9
    return recorded(
        fleet,
        [e for e in sent if not (type(e[2]) is Status and e[2].robot == silent and e[0] > late_ns)],
    )


def causes(recording: Recording, robot: int = 1) -> str:
    a = analyse(recording, resolve(recording.fleet))
    return Tracking(recording, a).causes(recording.ids.index(robot))


def test_own_words_count_for_a_while() -> None:
    assert causes(run(*FAR, reasons={1: "without robot 6 (75.0 s)"})) == "without robot 6 (75.0 s)"
    assert causes(run(*FAR)) == ""
    base = run(*FAR)
    one = base.robots[1]

    def until(t: float) -> str:
        reasons = ["on its way round post 4" if each <= t else "" for each in one.status.t]
        data = replace(one, status=replace(one.status, reasons=reasons))
        return causes(replace(base, robots={**base.robots, 1: data}))

    assert until(4.1) == "on its way round post 4 until 4.0 s"
    assert until(0.9) == ""


def test_what_the_safety_filter_kept_a_robot_from_is_named() -> None:
    """In more than a tenth of the ticks of the last 2 s; its limits are named by what sets them."""
    filtered = {1: {"any": 10, "robot 3": 8, "post 4": 9, "speed": 5, "robot 2": 0.5}}
    recording = run(*FAR, filtered=filtered)
    assert held_by(recording, 1, 4.0, 6.0) == ["post 4", "robot 3", "speed"]
    assert kept_from(recording, 1, 4.0, 6.0) == ["post 4", "robot 3"]
    assert causes(recording) == "held up by post 4 and robot 3; at the limit of control.max_speed_mps"


@pytest.mark.parametrize(
    ("filtered", "reason", "said"),
    [
        ("robot 3", "on its way round robot 3", "on its way round robot 3"),
        ("speed", "held back by its limit of speed", "held back by its limit of speed"),
        ("robot 3", "on its way round robot 30", "on its way round robot 30; held up by robot 3"),
    ],
)
def test_what_a_robot_names_itself_is_not_said_twice(filtered: str, reason: str, said: str) -> None:
    assert causes(run(*FAR, filtered={1: {filtered: 8}}, reasons={1: reason})) == said


def test_silence_is_named() -> None:
    filtered = {1: {"robot 3": 8}}
    assert causes(run(*FAR, filtered=filtered, silent=3)) == "held up by robot 3 (silent for 4 s)"
    assert causes(run(*FAR, silent=1)) == "its agent has said nothing for 4 s"
    said = "held back by robot 2 (its agent has said nothing for 4 s)"
    assert causes(run(*BOTH_FAR, silent=2)) == said


def test_a_robot_that_nothing_keeps_is_held_back_by_its_neighbours() -> None:
    recording = run(*BOTH_FAR, reasons={2: "on its way round post 7"})
    assert causes(recording) == "held back by robot 2 (on its way round post 7)"


@pytest.mark.parametrize(("speed_mps", "said"), [(3.0, True), (1.25, True), (1.1, False)])
def test_a_place_that_is_hard_to_catch_up_with_is_named(speed_mps: float, said: bool) -> None:
    base = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=6.0, velocity=(speed_mps, 0.0))
    expected = f"places move at {speed_mps:.2f} m/s and the limit is control.max_speed_mps = 1.5"
    assert causes(run(*FAR, fleet=base)) == (expected if said else "")


def test_a_shape_at_rest_is_named_with_all_that_are_in_it() -> None:
    """Both have come in from the other side and stand where the forces are in balance: found by driving."""
    fleet = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=6.0)
    fleet = replace(fleet, control=replace(fleet.control, kp=1.0))
    recording = run(standing(0.864, 0), standing(0.136, 0), fleet=fleet)
    shape = "robots 1 and 2 are at rest in another shape"
    assert causes(recording) == causes(recording, 2) == shape
