"""A robot that starts again: by which of the orders that it knows it drives."""

from __future__ import annotations

from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest
from handfast.agent.messages.codec import encode, mark_of
from handfast.agent.messages.types import Beacon, Mission, Resume, Stop
from handfast.agent.supervision.situation import NOT_SAID
from handfast.agent.supervision.state_machine import State
from tests.unit.agent.agent_bench import (
    MISSION,
    OTHERS_BEACON,
    OTHERS_TOLD,
    RESUME,
    START,
    STOP,
    TOLD,
    Bench,
    brakes,
)

VERSION = 5


@pytest.fixture
def bench() -> Bench:
    """A robot in the middle of the time of a mission, which has heard who is near."""
    made = Bench()
    made.listen()
    return made


def mission(bench: Bench, version: int = VERSION) -> Mission:
    return Mission(version, START, START - NS_PER_S, 60 * NS_PER_S, digest(bench.fleet))


def beacon(bench: Bench, of: Mission, *, following: bool = True) -> None:
    here = (1.5, 0.2, 0.0, 0.0, 0.0)
    bench.give(OTHERS_BEACON, Beacon(2, bench.ticks, bench.now, following, *here, *mark_of(of), -1, -1))


def recall(bench: Bench, *orders: Any) -> None:
    bench.agent.recall(bench.now, [encode(order) for order in orders])
    bench.agent.kept(bench.agent.lasting, "")


def drives(bench: Bench) -> bool:
    out = bench.run(3)[-1]
    assert (bench.state is State.RUNNING) is not brakes(out)
    return bench.state is State.RUNNING


def test_what_another_robot_relays_is_known_and_not_driven(bench: Bench):
    bench.give(OTHERS_TOLD, mission(bench))
    assert not drives(bench)
    assert bench.agent.condition == ("ready", NOT_SAID)
    outs = bench.run(20)
    assert not any(out.hand.following for out in outs)  # or two that only know would start each other
    assert not any(out.beacon.following for out in outs if out.beacon)
    assert {out.beacon.mission_version for out in outs if out.beacon} == {VERSION}
    assert bench.last.mission_version == 0  # so that who drives the fleet says it again


@pytest.mark.parametrize("how", ["recalled", "relayed"])
@pytest.mark.parametrize("word", ["mission", "resume", "somebody drives"])
def test_until_somebody_says_so_now(bench: Bench, how: str, word: str):
    if how == "recalled":
        recall(bench, mission(bench))
    else:
        bench.give(OTHERS_TOLD, mission(bench))
    bench.tick()
    if word == "mission":
        bench.give(MISSION, mission(bench))
    elif word == "resume":
        bench.give(RESUME, Resume(1, bench.now, ()))
    else:
        beacon(bench, mission(bench))
    assert drives(bench)


def test_not_by_a_resume_that_is_relayed_or_for_another(bench: Bench):
    recall(bench, mission(bench))
    bench.give(OTHERS_TOLD, Resume(1, bench.now, ()))
    bench.give(RESUME, Resume(2, bench.now, (2,)))
    assert not drives(bench)


def test_a_stop_that_was_kept_holds_whoever_drives(bench: Bench):
    recall(bench, Stop(9, START, "somebody in the way"), mission(bench))
    beacon(bench, mission(bench))
    bench.give(MISSION, mission(bench))
    assert not drives(bench)
    assert bench.agent.condition == ("stopped", "stop: somebody in the way")
    bench.give(RESUME, Resume(10, bench.now, ()))
    assert drives(bench)
    assert bench.last.order_version == 0  # not on its disk yet
    bench.agent.kept(bench.agent.lasting, "")
    bench.run(12)
    assert bench.last.order_version == 10


def test_it_relays_what_it_recalls_a_stop_first(bench: Bench):
    recall(bench, Stop(9, START, ""), mission(bench))
    assert [key for key, _ in bench.tick().raw if key == TOLD]
    first = Bench()
    first.agent.recall(first.now, [encode(Stop(9, START, "")), encode(mission(first))])
    assert [type(message) for message in first.tick().told] == [Stop, Mission]


def test_an_old_stop_or_resume_has_no_effect_after_what_was_kept(bench: Bench):
    recall(bench, Stop(9, START, "now"), mission(bench))
    for order, key in ((Stop(8, START, "old"), STOP), (Resume(8, START, ()), RESUME)):
        bench.give(key, order)
    bench.run(2)
    assert bench.agent.condition == ("stopped", "stop: now")


def test_orders_are_acknowledged_when_they_are_kept(bench: Bench):
    recall(bench)
    bench.give(MISSION, mission(bench))
    bench.stop(6)
    bench.run(12)
    assert bench.state is State.STOPPED  # obeyed at once
    assert (bench.last.mission_version, bench.last.order_version) == (0, 0)
    bench.agent.kept(bench.agent.lasting, "")
    bench.tick()  # and said at once: operators wait for it
    assert (bench.last.mission_version, bench.last.order_version) == (VERSION, 6)


DAY_US = 24 * 3600 * 1_000_000


def test_what_an_operator_says_whose_clock_is_days_ahead_takes_no_stop_away(bench: Bench):
    """Its resume would be later than every stop of right clocks; its stop is one that is given now."""
    bench.give(MISSION, mission(bench))
    assert drives(bench)
    ahead = bench.now // 1_000 + 2 * DAY_US
    bench.give(RESUME, Resume(ahead, bench.now, ()))
    bench.give(MISSION, mission(bench, ahead))
    bench.stop(bench.now // 1_000, "by a right clock")
    bench.tick()
    assert bench.agent.condition == ("stopping", "stop: by a right clock")
    bench.resume(bench.now // 1_000 + 1)
    bench.run(3)
    assert bench.state is State.RUNNING
    bench.give(STOP, Stop(ahead, bench.now, "by a wrong clock"))
    bench.tick()
    assert bench.agent.condition == ("stopping", "stop: by a wrong clock")
    bench.resume(bench.now // 1_000 + 1)
    bench.run(3)
    assert bench.state is State.RUNNING
    assert bench.counters()["rejected.future"] == 3
