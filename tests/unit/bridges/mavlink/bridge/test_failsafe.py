"""Whether the vehicle's own failsafe has it, or its operator."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.bridge.authority import TOGETHER_NS, OwnFailsafe

HOLD, MANUAL = "mode HOLD, not GUIDED", "mode MANUAL, not GUIDED"
T0 = 1000 * NS_PER_S


@pytest.mark.parametrize(
    "text",
    [
        "EKF failsafe",
        "Radio Failsafe",
        "GCS Failsafe",
        "Battery 1 is low 10.50V used 0 mAh",
        "Battery 2 is critical 9.80V used 900 mAh",
        "Crash: Going to HOLD",
        "Fence Breached",
    ],
)
@pytest.mark.parametrize("ahead_ns", [-TOGETHER_NS, 0, TOGETHER_NS])
def test_a_failsafe_that_is_said_as_the_mode_changes_is_why(text: str, ahead_ns: int) -> None:
    found = OwnFailsafe()
    found.step(T0 - TOGETHER_NS, "")
    for at_ns, said in sorted([(T0, ""), (T0 + ahead_ns, text)], key=lambda each: (each[0], each[1])):
        if said:
            found.hear(at_ns, said)
        found.step(at_ns, HOLD if at_ns >= T0 else "")
    assert found.why == text
    found.step(T0 + 60 * NS_PER_S, HOLD)  # for as long as it has it
    assert found.why == text


@pytest.mark.parametrize(
    "text", ["GCS Failsafe Cleared", "EKF failsafe cleared", "Throttle armed", "PreArm: x"]
)
def test_what_is_no_failsafe(text: str) -> None:
    found = OwnFailsafe()
    found.step(T0 - 1, "")
    found.hear(T0, text)
    found.step(T0, HOLD)
    assert found.why == ""


def test_its_operator_may_take_it_from_the_failsafe_and_another_time_is_another_matter() -> None:
    found = OwnFailsafe()
    found.step(T0 - 1, "")
    found.hear(T0, "EKF failsafe")
    found.step(T0, HOLD)
    found.step(T0 + 1, MANUAL)
    assert found.why == ""
    found.step(T0 + 2, HOLD)
    assert found.why == ""
    found.step(T0 + 3, "")
    assert found.why == ""
    found.step(T0 + TOGETHER_NS + 2, HOLD)
    assert found.why == ""


def test_a_vehicle_that_was_never_given_over_is_its_operators() -> None:
    found = OwnFailsafe()
    found.hear(T0, "EKF failsafe")
    found.step(T0 + TOGETHER_NS + 1, HOLD)
    assert found.why == ""
