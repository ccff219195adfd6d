"""handfast.agent.supervision.deafness: whom a robot is deaf to, and whom it only does not hear."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.types import Beacon
from handfast.agent.supervision.deafness import LATE_NS, PAUSE_MAX_NS, PAUSE_NS, SURE_NS, Deafness
from handfast.agent.supervision.state_machine import State
from tests.unit.agent.fleet_bench import FleetBench, three

HORIZON_NS = 2 * NS_PER_S
STEP_NS = NS_PER_S // 5
T0 = 1000 * NS_PER_S


def beacon(robot: int, now_ns: int, unheard: tuple[int, ...] = ()) -> Beacon:
    place = 0.0, 0.0, 0.0, 0.0
    return Beacon(robot, 0, now_ns, True, *place, 0.0, 0, 0, -1, -1, (), unheard)


class Bench:
    """What a robot hears of robots 2, 3 and 4, five times a second."""

    def __init__(
        self, *, present: tuple[int, ...] = (2, 3, 4), one_link: bool = False, seldom_ns: int = 0
    ) -> None:
        self.deafness = Deafness(
            (2, 3, 4), HORIZON_NS, seldom_ns=seldom_ns, sees_all=not one_link, one_link=one_link
        )
        self.now_ns = T0
        self.deafness.look(T0)
        for robot in present:
            self.deafness.present(robot, True)
        self.found: list[tuple[int, float]] = []

    def run(
        self,
        duration_s: float,
        heard: tuple[int, ...] = (2, 3, 4),
        *,
        hands: tuple[int, ...] = (),
        listened: tuple[int, ...] = (),
        unheard: Callable[[int], tuple[int, ...]] = lambda _: (),
    ) -> list[int]:
        """Goes on for so long; robots that it was deaf to."""
        found = []
        self.deafness.listens(listened, self.now_ns)
        for _ in range(round(duration_s * NS_PER_S / STEP_NS)):
            self.now_ns += STEP_NS
            for robot in heard:
                self.deafness.came(robot, self.now_ns, hand=False)
                self.deafness.told(beacon(robot, self.now_ns, unheard(robot)))
            for robot in hands:
                self.deafness.came(robot, self.now_ns, hand=True)
            found += self.deafness.look(self.now_ns)
        return found


def test_who_is_heard_by_others_and_not_here_is_found() -> None:
    bench = Bench()
    assert bench.run(10) == []
    assert bench.run((HORIZON_NS + LATE_NS) / NS_PER_S, (3, 4)) == []
    assert bench.run(1.0, (3, 4)) == [2]


def test_of_whom_beacons_are_seldom_nothing_may_come_for_longer() -> None:
    bench = Bench(seldom_ns=3 * NS_PER_S)
    assert bench.run(10) == []
    assert bench.run((HORIZON_NS + LATE_NS + SURE_NS) / NS_PER_S + 2.9, (3, 4)) == []
    assert bench.run(1.0, (3, 4)) == [2]


def test_of_one_whose_process_stood_others_may_have_heard_just_now() -> None:
    """A robot of 30 that was frozen for 3 s: one that was no neighbour of it opened its only link anew."""
    bench = Bench(seldom_ns=NS_PER_S)
    assert bench.run(10) == []
    silent_s = (HORIZON_NS + LATE_NS) / NS_PER_S + 1.2
    assert bench.run(silent_s, (3, 4), unheard=lambda _: (2,)) == []
    assert bench.run(0.6, (3, 4)) == [], "they hear it again"
    assert bench.run(10) == []


def test_so_is_one_that_was_never_heard() -> None:
    assert Bench().run(4, (3, 4)) == [2]


def test_pauses_grow_while_it_does_not_help() -> None:
    bench = Bench()
    times = []
    for _ in range(1500):
        if bench.run(0.2, (3, 4)):
            times.append(bench.now_ns)
    gaps = [(after - before) // NS_PER_S for before, after in pairwise(times)]
    assert gaps[:4] == [2, 4, 8, 16]
    assert max(gaps) <= PAUSE_MAX_NS // NS_PER_S + 1


def test_after_a_while_of_hearing_it_the_pause_is_short_again() -> None:
    bench = Bench()
    bench.run(30, (3, 4))
    bench.run(3 * PAUSE_MAX_NS / NS_PER_S)
    assert bench.run(4 + PAUSE_NS / NS_PER_S, (3, 4)) == [2, 2]


def test_one_that_has_ended_or_cannot_be_reached_is_not() -> None:
    bench = Bench()
    bench.run(5)
    bench.deafness.present(2, False)
    assert bench.run(30, (3, 4)) == []
    bench.deafness.present(2, True)
    assert bench.run(4, (3, 4)) == [2]


def test_one_that_others_do_not_hear_either_is_not() -> None:
    """Its loop hangs, it is frozen, or it has no plant that says where it is."""
    bench = Bench()
    bench.run(5)
    then_ns = bench.now_ns
    late = lambda _: (2,) if bench.now_ns - then_ns > HORIZON_NS + LATE_NS // 2 else ()  # noqa: E731
    assert bench.run(30, (3, 4), unheard=late) == []


def test_alone_with_another_nothing_can_be_said() -> None:
    assert Bench().run(30, ()) == []


def test_where_all_come_over_one_link_nothing_at_all_is_told_by_tokens() -> None:
    bench = Bench(present=(3, 4), one_link=True)
    assert bench.run(10, hands=(3, 4), listened=(3, 4)) == []
    assert bench.run((HORIZON_NS + LATE_NS) / NS_PER_S, (), listened=(3, 4)) == []
    assert bench.run(1.0, (), listened=(3, 4)) == [3]
    assert bench.run(20.0, (), listened=(3, 4)) == [3, 3, 3], "after 2, 4 and 8 s"
    assert Bench(present=(3, 4)).run(30.0, (), listened=(3, 4)) == [], (
        "over links of their own they may be off"
    )
    alone = Bench(present=(), one_link=True)
    assert alone.run(30.0, (), listened=(3, 4)) == [], "nobody is there"


def test_one_that_is_listened_to_and_only_its_beacons_come_is_found() -> None:
    bench = Bench()
    assert bench.run(5, hands=(2,), listened=(2,)) == []
    assert bench.run(2.2, listened=(2,)) == [2]


def test_one_that_says_nothing_to_anybody_is_not() -> None:
    bench = Bench()
    bench.run(5, hands=(2,), listened=(2,))
    assert bench.run(2, (3, 4), listened=(2,)) == []


def test_a_stranger_changes_nothing() -> None:
    bench = Bench()
    bench.deafness.present(99, True)
    assert bench.run(5) == []


# ---------------------------------------------------------------------- whole agents


def deaf(bench: FleetBench, seconds: float) -> set[tuple[int, int]]:
    """Goes on for so long: (who, to whom) was deaf."""
    found = set()
    for _ in range(round(5 * seconds)):
        bench.run(0.2)
        found |= {(who, whom) for who, agent in bench.agents.items() for whom in agent.deaf_to(bench.now)}
    return found


def meet(bench: FleetBench) -> None:
    for agent in bench.agents.values():
        for robot in bench.agents:
            agent.present(f"few/alive/robot/{robot}/agent", True)


@pytest.mark.slow
def test_an_agent_to_which_nothing_of_a_neighbour_is_delivered_is_deaf_to_it():
    bench = FleetBench(three())
    meet(bench)
    assert deaf(bench, 6) == set()
    bench.cut = lambda key, node: node is bench.agents[1] and key.startswith("few/robot/3/")
    assert deaf(bench, 6) == {(1, 3)}


@pytest.mark.slow
def test_one_that_loses_them_by_a_rule_is_not():
    rule = 'faults.rule=[{ link = "3->1", loss = "100%" }, { link = "2->1", delay = "3s" }]'
    bench = FleetBench(three(rule))
    meet(bench)
    bench.drive()
    bench.run(3.0)
    assert bench.agents[1].state is not State.RUNNING, "the rules hold"
    assert deaf(bench, 12) == set()
