"""Who has a vehicle: every way in and out of the bridge's hands."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.supervision.orders import AWAITED
from handfast.bridges.mavlink.bridge.authority import REBOOTED, TRANSITIONS, Authority, Holder

MANUAL = "mode MANUAL, not GUIDED"
LOST = "no heartbeat for 4 s"


def driving() -> Authority:
    """A vehicle that was handed over and told to drive."""
    authority = Authority()
    authority.step("", "")
    assert authority.clear_to_drive()
    authority.step("", "")
    assert authority.holder is Holder.BRIDGE
    assert authority.why == ""
    return authority


def test_nothing_may_be_commanded_before_the_vehicle_is_there() -> None:
    authority = Authority()
    assert authority.holder is Holder.NOBODY
    assert authority.why
    authority.step("waiting for a heartbeat", "")
    assert (authority.holder, authority.why) == (Holder.NOBODY, "waiting for a heartbeat")


def test_before_the_fleet_is_told_to_drive_the_operator_may_hand_over_and_take_back_at_will() -> None:
    authority = Authority()
    for _ in range(3):
        authority.step("", MANUAL)
        assert (authority.holder, authority.why) == (Holder.OPERATOR, MANUAL)
        authority.step("", "")
        assert authority.holder is Holder.BRIDGE


def test_another_mode_releases_at_once_and_going_back_is_not_enough() -> None:
    authority = driving()
    row = authority.step("", MANUAL)
    assert row is not None
    assert row.name == "taken"
    assert (authority.holder, authority.why) == (Holder.RELEASED, f"its operator has it: {MANUAL}")
    authority.step("", "")
    assert authority.holder is Holder.RELEASED
    assert authority.why.endswith(AWAITED)
    assert MANUAL in authority.why
    assert authority.clear_to_drive()
    authority.step("", "")
    assert authority.holder is Holder.BRIDGE


def test_leave_to_resume_counts_only_once_the_operator_has_given_it_back() -> None:
    authority = driving()
    authority.step("", MANUAL)
    assert not authority.clear_to_drive()
    authority.step("", "")
    assert authority.holder is Holder.RELEASED
    authority.step("", "")
    assert authority.holder is Holder.RELEASED


def test_a_mission_that_finds_the_operator_driving_does_not_take_the_vehicle_from_him_later() -> None:
    authority = Authority()
    authority.step("", MANUAL)
    assert not authority.clear_to_drive()
    authority.step("", MANUAL)
    authority.step("", "")
    assert authority.holder is Holder.RELEASED


def test_a_vehicle_that_may_have_been_had_while_nobody_heard_it_waits_for_a_resume() -> None:
    authority = driving()
    authority.step(LOST, "")
    assert not authority.clear_to_drive(), "said meanwhile, it does not count later"
    row = authority.step("", "", lapse="nothing was heard of it for 4.0 s")
    assert row is not None
    assert row.name == "lapsed"
    for vehicle in ("", LOST, ""):
        authority.step(vehicle, "")
        assert authority.holder is Holder.RELEASED
    assert authority.why == f"nothing was heard of it for 4.0 s: {AWAITED}"
    assert authority.clear_to_drive()
    authority.step("", "")
    assert authority.holder is Holder.BRIDGE


def test_a_vehicle_that_rebooted_was_not_taken_by_its_operator() -> None:
    authority = driving()
    authority.step(LOST, "")
    authority.step("", MANUAL)
    assert authority.why == f"its operator has it: {MANUAL}"
    authority.step("", MANUAL, lapse=REBOOTED)  # which is known a little later
    authority.step("", MANUAL)
    assert authority.why == f"{REBOOTED}: {MANUAL}"
    authority.step("", "")
    assert authority.why.endswith(AWAITED)
    assert authority.clear_to_drive()
    authority.step("", "")
    authority.step("", MANUAL)
    assert authority.why == f"its operator has it: {MANUAL}"


def test_a_vehicle_that_its_operator_has_is_his_also_when_he_reboots_it() -> None:
    authority = driving()
    authority.step("", MANUAL)
    authority.step("", MANUAL, lapse=REBOOTED)
    authority.step("", MANUAL)
    assert authority.why == f"its operator has it: {MANUAL}"


def test_who_takes_it_after_it_was_given_back_is_its_operator_whatever_was_before() -> None:
    authority = driving()
    authority.step(LOST, "")
    authority.step("", MANUAL, lapse=REBOOTED)
    authority.step("", "")
    authority.step("", MANUAL)
    assert authority.why == f"its operator has it: {MANUAL}"


def test_a_resume_counts_as_soon_as_it_is_heard_and_given_back_whatever_else_is_wrong() -> None:
    """It listens for other bridges after a lost link, and its GPS may take longer."""
    authority = driving()
    authority.step(LOST, "")
    authority.step("listens", "", lapse="nothing was heard of it for 4.0 s", heard=True)
    authority.step("listens", "", heard=True)
    assert authority.clear_to_drive()
    authority.step("listens", "", heard=True)
    assert authority.holder is Holder.NOBODY
    authority.step("", "", heard=True)
    assert authority.holder is Holder.BRIDGE
    authority.step("listens", MANUAL, heard=True)
    assert not authority.clear_to_drive()


def test_a_vehicle_that_rebooted_and_is_in_guided_waits_for_a_resume() -> None:
    authority = driving()
    authority.step("", "", lapse=REBOOTED)
    authority.step("", "")
    assert authority.why == f"{REBOOTED}: {AWAITED}"


def test_nobody_waits_for_a_resume_of_a_vehicle_that_was_never_told_to_drive() -> None:
    authority = Authority()
    authority.step("", "", lapse="nothing was heard of it for 4.0 s")
    assert authority.holder is Holder.BRIDGE


def test_a_lost_link_that_comes_back_in_guided_goes_on_by_itself() -> None:
    authority = driving()
    authority.step(LOST, "")
    assert (authority.holder, authority.why) == (Holder.NOBODY, LOST)
    authority.step("", "")
    assert authority.holder is Holder.BRIDGE


def test_a_vehicle_that_comes_back_in_another_mode_is_released() -> None:
    authority = driving()
    authority.step(LOST, "")
    authority.step("", "disarmed")
    assert authority.holder is Holder.RELEASED
    authority.step(LOST, "")
    authority.step("", "")
    assert authority.holder is Holder.RELEASED, "a lost link must not wash the release away"


def test_a_vehicle_that_was_taken_while_its_estimate_was_bad_is_released() -> None:
    authority = driving()
    authority.step("its EKF is bad", MANUAL)
    assert (authority.holder, authority.why) == (Holder.RELEASED, "its EKF is bad")
    authority.step("its EKF is bad", "")
    authority.step("", "")
    assert authority.holder is Holder.RELEASED


def test_no_order_to_drive_is_known_before_one_was_given() -> None:
    authority = Authority()
    authority.step("", "")
    assert not authority.cleared
    authority.clear_to_drive()
    assert authority.cleared


def test_an_order_to_drive_while_the_operator_has_it_counts_at_once() -> None:
    authority = Authority()
    authority.step("", MANUAL)
    authority.clear_to_drive()
    authority.step("", "")  # given back before the next look
    assert authority.holder is Holder.RELEASED


def test_a_restarted_bridge_drives_on_only_where_nobody_took_the_vehicle() -> None:
    untouched, taken = Authority(), Authority()
    for authority in (untouched, taken):
        authority.clear_to_drive()  # the mission comes again before the vehicle is heard
    untouched.step("", "")
    assert untouched.holder is Holder.BRIDGE
    taken.step("", MANUAL)
    taken.step("", "")
    assert taken.holder is Holder.RELEASED


def test_a_vehicle_that_does_not_follow_is_let_go_until_told() -> None:
    authority = driving()
    authority.step("", "", "does not follow its commands")
    assert authority.holder is Holder.RELEASED
    assert "does not follow" in authority.why
    assert authority.clear_to_drive()
    authority.step("", "")
    assert authority.holder is Holder.BRIDGE


def test_every_row_has_a_name_of_its_own_and_none_leaves_released() -> None:
    names = [row.name for row in TRANSITIONS]
    assert len(set(names)) == len(names)
    assert not any(Holder.RELEASED in row.sources for row in TRANSITIONS)


steps = st.lists(
    st.tuples(st.sampled_from(["", LOST]), st.sampled_from(["", MANUAL]), st.booleans()), max_size=40
)


@given(steps)
def test_commands_flow_only_when_all_is_well_and_never_again_without_leave(
    steps: list[tuple[str, str, bool]],
) -> None:
    authority, cleared, latched = Authority(), False, False
    for vehicle, operator, told in steps:
        authority.step(vehicle, operator)
        if authority.holder is Holder.BRIDGE:
            assert (vehicle, operator, latched) == ("", "", False)
            assert authority.why == ""
        else:
            assert authority.why
        latched = latched or (cleared and bool(operator))
        if told:
            cleared = True
            latched = bool(operator) or (latched and bool(vehicle))
            authority.clear_to_drive()


@pytest.mark.parametrize("trouble", ["", LOST])
def test_going_ahead_says_whether_the_vehicle_can(trouble: str) -> None:
    authority = Authority()
    authority.step(trouble, "")
    assert authority.clear_to_drive() is (trouble == "")
