"""Robots that were let go: by their operators, or because they did not follow."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.messages.types import Status
from handfast.bridges.mavlink.bridge.authority import REBOOTED, UNHEARD, Authority
from handfast.bridges.mavlink.bridge.backend import BEGUN_LATE, FENCED, NOT_HEARD_YET
from handfast.bridges.mavlink.bridge.estimate import Residual
from handfast.bridges.mavlink.bridge.setpoint import MotionCheck
from handfast.deploy.verdict.reasons import NOT_ITS_OPERATORS, PERHAPS_ITS_OPERATORS
from tests.unit.deploy.judged_run import PAIR, body, judged
from tests.unit.deploy.synthetic_run import EPOCH_NS, messages, standing

STUCK = "does not follow its commands: asked for 0.40 m/s, moves at 0.02 m/s: waiting to be told to resume"
HOLD = "its operator has it: mode HOLD, not GUIDED"


def said(*told: tuple[float, str, str]) -> Any:
    """The verdict on a perfect run whose robot 2 says these states and reasons, each from a time on."""
    sent = []
    for received, key, message in messages(PAIR, [body(standing(x, 0), 0.1) for x in (0, 1)]):
        if type(message) is Status and message.robot == 2:
            for from_s, state, reason in told:
                if (message.time_ns - EPOCH_NS) / 1e9 >= from_s:
                    message = message._replace(state=state, reason=reason)
        sent.append((received, key, message))
    return judged(PAIR, sent)["verdict"]


def test_one_that_stopped_following_for_good_fails_with_its_reason() -> None:
    found = said((0.5, "released", STUCK))
    assert found["reasons"] == [
        f"Robot 2 followed no more from 0.6 s to the end, and its operator had not taken it: {STUCK}."
    ]
    assert found["warnings"] == []


def test_that_its_operator_came_for_it_later_does_not_make_it_his_doing() -> None:
    assert not said((0.5, "released", STUCK), (1.0, "released", HOLD))["passed"]


@pytest.mark.parametrize(
    "reason", [HOLD, "its operator has it: disarmed", "mode MANUAL", "", f"its plant was lost: {STUCK}"]
)
def test_one_that_its_operator_took_is_a_warning(reason: str) -> None:
    found = said((0.5, "released", reason))
    assert (found["passed"], found["reasons"]) == (True, [])
    why = f" ({reason})" if reason else ""
    assert found["warnings"] == [f"Robot 2 was released to its operator from 0.6 s to the end{why}."]


def test_one_that_followed_again_is_a_warning_without_an_operator() -> None:
    found = said((0.5, "released", STUCK), (1.1, "running", ""))
    assert found["passed"]
    assert found["warnings"] == [f"Robot 2 was released from 0.6 s to 1.2 s ({STUCK})."]


def test_one_that_nobody_heard_is_its_operators_once_he_is_seen_to_have_it() -> None:
    lapsed = (
        "nothing was heard of it for 5.0 s, and its operator may have had it: waiting to be told to resume"
    )
    assert not said((0.5, "released", lapsed))["passed"]
    found = said((0.5, "released", lapsed), (1.0, "released", HOLD))
    assert found["passed"]
    (warning,) = found["warnings"]
    assert warning.startswith(f"Robot 2 was released to its operator from 0.6 s to the end ({lapsed}).")


def test_these_are_the_bridges_own_words() -> None:
    """What it says of itself, and of its operator, as its own parts make it."""
    check, authority = MotionCheck(), Authority()
    authority.clear_to_drive()
    authority.step("", "")
    refusal = ""
    for _ in range(100):
        refusal = refusal or check.step(0.1, True, (0.4, 0.0), Residual(-0.4, 0.0))
    authority.step("", "", refusal)
    assert authority.why.startswith(NOT_ITS_OPERATORS)
    authority.step("", "mode HOLD, not GUIDED")
    assert not authority.why.startswith(NOT_ITS_OPERATORS)
    authority.step("", "mode HOLD, not GUIDED", failsafe="EKF failsafe")
    assert authority.why == "its own failsafe has it: mode HOLD, not GUIDED (EKF failsafe)"
    assert authority.why.startswith(NOT_ITS_OPERATORS)
    assert FENCED.startswith(NOT_ITS_OPERATORS)
    assert BEGUN_LATE.startswith(PERHAPS_ITS_OPERATORS)
    assert NOT_HEARD_YET.startswith(PERHAPS_ITS_OPERATORS)

    lost = Authority()
    lost.clear_to_drive()
    lost.step("", "")
    lost.step("", "", lapse=f"{UNHEARD} for 4.0 s")
    assert lost.why.startswith(PERHAPS_ITS_OPERATORS)
    assert REBOOTED.startswith(PERHAPS_ITS_OPERATORS)

    taken = Authority()
    taken.clear_to_drive()
    taken.step("", "")
    taken.step("", "mode HOLD, not GUIDED")
    assert taken.why == HOLD
    taken.step("", "")
    assert "given it back" in taken.why
    assert not taken.why.startswith(NOT_ITS_OPERATORS)
