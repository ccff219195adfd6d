"""Taking a vehicle over: GUIDED, then arming, once; its operator's hand ends it."""

from __future__ import annotations

from typing import Any, cast

import pytest

from handfast.bridges.mavlink.ardupilot.constants import MODE_GUIDED, MODE_HOLD, MODE_MANUAL
from handfast.bridges.mavlink.bridge.authority import TAKEOVER_PERIOD_NS, Holder, Takeover
from handfast.bridges.mavlink.session.session import Session


class Link:
    """A session, as far as a takeover sees it."""

    def __init__(self) -> None:
        self.mode: int | None = MODE_HOLD
        self.armed = False
        self.asked: list[Any] = []

    def command_mode(self, mode: int) -> None:
        self.asked.append(mode)

    def command_arm(self, arm: bool) -> None:
        self.asked.append(arm)


@pytest.fixture
def link() -> Link:
    return Link()


def made(link: Link, *, wanted: bool = True) -> Takeover:
    return Takeover(cast(Session, link), lambda _: None, wanted=wanted)


def test_it_asks_for_guided_then_arms_and_repeats_with_patience(link: Link) -> None:
    takeover = made(link)
    for now_ns in (0, TAKEOVER_PERIOD_NS - 1, TAKEOVER_PERIOD_NS):
        takeover.step(now_ns, Holder.OPERATOR, "")
    assert link.asked == [MODE_GUIDED, MODE_GUIDED]
    assert not takeover.armed_here
    link.mode = MODE_GUIDED
    takeover.step(2 * TAKEOVER_PERIOD_NS - 1, Holder.OPERATOR, "")
    takeover.step(2 * TAKEOVER_PERIOD_NS, Holder.OPERATOR, "")
    assert link.asked[2:] == [True]
    assert takeover.armed_here


@pytest.mark.parametrize(
    ("holder", "trouble"), [(Holder.OPERATOR, "no GPS"), (Holder.NOBODY, ""), (Holder.RELEASED, "")]
)
def test_it_asks_for_nothing_while_something_is_wrong(link: Link, holder: Holder, trouble: str) -> None:
    made(link).step(0, holder, trouble)
    assert link.asked == []


def test_it_asks_for_nothing_where_it_is_not_wanted(link: Link) -> None:
    made(link, wanted=False).step(0, Holder.OPERATOR, "")
    assert link.asked == []


def test_a_vehicle_that_somebody_drives_is_left_alone(link: Link) -> None:
    link.mode, link.armed = MODE_MANUAL, True
    made(link).step(0, Holder.OPERATOR, "")
    assert link.asked == []


def test_once_it_obeyed_it_is_asked_no_more(link: Link) -> None:
    takeover = made(link)
    takeover.step(0, Holder.BRIDGE, "")
    takeover.step(TAKEOVER_PERIOD_NS, Holder.OPERATOR, "")
    assert link.asked == []


@pytest.mark.parametrize("trouble", ["", "no GPS"])
def test_an_operator_who_takes_it_out_of_guided_ends_it(link: Link, trouble: str) -> None:
    takeover = made(link)
    link.mode = MODE_GUIDED
    takeover.step(0, Holder.NOBODY, trouble)
    link.mode = MODE_HOLD
    takeover.step(1, Holder.NOBODY, trouble)
    takeover.step(TAKEOVER_PERIOD_NS, Holder.OPERATOR, "")
    assert link.asked == []


def test_a_new_life_forgets_the_mode_of_before(link: Link) -> None:
    takeover = made(link)
    link.mode = MODE_GUIDED
    takeover.step(0, Holder.NOBODY, "")
    takeover.begin_again()
    link.mode = MODE_HOLD
    takeover.step(1, Holder.OPERATOR, "")
    assert link.asked == [MODE_GUIDED]


def test_what_its_operator_arms_again_was_not_armed_here(link: Link) -> None:
    takeover = made(link)
    link.mode = MODE_GUIDED
    takeover.step(0, Holder.OPERATOR, "")
    assert takeover.armed_here
    link.armed = True
    takeover.step(1, Holder.RELEASED, "")
    assert takeover.armed_here
    link.armed = False
    takeover.step(2, Holder.RELEASED, "")
    assert not takeover.armed_here
