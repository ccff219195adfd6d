"""What is said again so that others catch up: by whom, when, and what all end with."""

from __future__ import annotations

from math import cos, pi, sin

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Ask, Mission, Resume, Stop, Wrench
from handfast.agent.supervision.orders import AGAIN_NS, LACKING_NS, SPREAD_NS, STEPS, Gossip
from handfast.agent.supervision.state_machine import DRIVING, State
from tests.unit.agent.fleet_bench import ASK, MISSION, PERIOD, RESUME, STOP, FleetBench, three

T0 = 1000 * NS_PER_S


class Teller:
    """Calls `due` every tick, as an agent does."""

    def __init__(
        self, robot: int = 3, version: int = 5, step_ns: int = SPREAD_NS, is_shared: bool = False
    ) -> None:
        self.version = version
        self.gossip = Gossip(robot, lambda: (self.version, 0), step_ns, is_shared=is_shared)

    def says(self, begin_ns: int, end_ns: int) -> list[int]:
        """Ticks from `begin_ns` until before `end_ns` at which it says it."""
        return [now for now in range(begin_ns, end_ns, PERIOD) if self.gossip.due(now)]


# ---------------------------------------------------------------------- one robot


def test_it_is_said_once_to_who_knows_less():
    teller = Teller(robot=3)
    teller.gossip.lacks(T0, (4, 0))
    assert teller.says(T0, T0 + 5 * NS_PER_S) == [T0 + 3 * SPREAD_NS]


@pytest.mark.parametrize("version", [5, 6])
def test_it_is_not_said_to_who_knows_as_much(version: int):
    teller = Teller()
    teller.gossip.lacks(T0, (version, 0))
    assert teller.says(T0, T0 + NS_PER_S) == []


def test_robots_wait_for_different_times():
    first = []
    for robot in range(STEPS):
        teller = Teller(robot)
        teller.gossip.lacks(T0, (0, 0))
        first += teller.says(T0, T0 + NS_PER_S)
    assert len(set(first)) == STEPS
    assert max(first) < T0 + STEPS * SPREAD_NS


def test_what_is_learnt_is_said_at_once():
    teller = Teller(robot=3)
    teller.gossip.said(T0, (5, 0))
    teller.gossip.learnt(T0)
    assert teller.says(T0, T0 + NS_PER_S) == [T0]


def test_what_many_learn_at_once_the_first_of_them_say():
    tellers = [Teller(robot, step_ns=PERIOD, is_shared=True) for robot in range(4 * STEPS)]
    said = []
    for teller in tellers:
        teller.gossip.said(T0, (5, 0))  # by the operator
        teller.gossip.learnt(T0)
    for now in range(T0, T0 + 2 * NS_PER_S, PERIOD):
        saying = [number for number, teller in enumerate(tellers) if teller.gossip.due(now)]
        said += saying
        for teller in tellers if saying else ():
            teller.gossip.said(now, (5, 0))
    assert said == list(range(0, 4 * STEPS, STEPS))
    alone = Teller(robot=3, step_ns=PERIOD, is_shared=True)  # and who hears nobody else say it says it
    alone.gossip.learnt(T0)
    assert alone.says(T0, T0 + NS_PER_S) == [T0 + 3 * PERIOD]


def test_who_hears_another_say_it_is_quiet():
    teller = Teller()
    teller.gossip.lacks(T0, (4, 0))
    teller.gossip.said(T0 + PERIOD, (5, 0))
    assert teller.says(T0 + PERIOD, T0 + NS_PER_S) == []


@pytest.mark.parametrize("every", [1, 5, 24])
@pytest.mark.parametrize("robot", [0, 7])
def test_who_lacks_it_is_told_though_another_says_it_all_the_while(robot: int, every: int):
    """A robot that was taken over may say it to all but the one who lacks it."""
    teller = Teller(robot)
    said = []
    teller.gossip.said(T0 - PERIOD, (5, 0))
    for tick, now in enumerate(range(T0, T0 + 2 * LACKING_NS, PERIOD)):
        teller.gossip.lacks(now, (4, 0))
        said += [now] * teller.gossip.due(now)
        if tick % every == every - 1:
            teller.gossip.said(now, (5, 0))
    assert said == [T0 + LACKING_NS + robot * SPREAD_NS]


def test_who_lacked_it_long_ago_and_not_since_does_not_make_the_next_one_urgent():
    teller = Teller(robot=1)
    teller.gossip.lacks(T0, (4, 0))
    teller.gossip.said(T0 + PERIOD, (5, 0))
    later = T0 + 10 * NS_PER_S
    teller.gossip.said(later - PERIOD, (5, 0))
    teller.gossip.lacks(later, (4, 0))
    assert teller.says(later, later + NS_PER_S) == [later - PERIOD + AGAIN_NS + SPREAD_NS]


def test_who_lacked_it_and_was_told_by_another_does_not_have_all_answer_the_next_that_asks():
    """Of a fleet of 100 all 100 answered, who had all heard an old beacon of somebody when they stopped."""
    teller = Teller(robot=1)
    teller.gossip.lacks(T0, (4, 0))
    teller.gossip.said(T0 + PERIOD, (5, 0))
    later = T0 + 10 * NS_PER_S
    teller.gossip.asked(later)
    teller.gossip.said(later + PERIOD // 2, (5, 0))
    assert teller.says(later, later + NS_PER_S) == []


def test_an_older_one_that_another_says_is_not_it():
    teller = Teller()
    teller.gossip.lacks(T0, (3, 0))
    teller.gossip.said(T0 + PERIOD, (4, 0))
    assert len(teller.says(T0 + PERIOD, T0 + NS_PER_S)) == 1


def test_it_is_not_said_again_at_once_but_it_is_said_again():
    """The beacon of a robot that was just told may be on its way still."""
    teller = Teller(robot=0)
    said = []
    for now in range(T0, T0 + 2 * NS_PER_S, PERIOD):
        teller.gossip.lacks(now, (4, 0))  # nobody hears it
        said += [now] * teller.gossip.due(now)
    assert said[:3] == [T0, T0 + AGAIN_NS, T0 + 2 * AGAIN_NS]


def test_who_asks_is_told_though_it_was_said_lately():
    """It may not hear what others have said."""
    teller = Teller(robot=1)
    teller.gossip.said(T0, (5, 0))
    teller.gossip.asked(T0 + PERIOD)
    assert teller.says(T0 + PERIOD, T0 + NS_PER_S) == [T0 + PERIOD + SPREAD_NS]


# ---------------------------------------------------------------------- a fleet


def ring(robots: int) -> Fleet:
    """Each with two neighbours, in place."""
    places = [
        (cos(2 * pi * k / robots) * robots / 4, sin(2 * pi * k / robots) * robots / 4) for k in range(robots)
    ]
    rows = ", ".join(f"{{ id = {k + 1}, x_m = {x:.3f}, y_m = {y:.3f} }}" for k, (x, y) in enumerate(places))
    text = f"""
    robot = [{rows}]
    fleet = {{ name = "few", rate_hz = 50 }}
    formation = {{ edges = {[[k + 1, (k + 1) % robots + 1] for k in range(robots)]},
                  offsets = {[[round(x, 3), round(y, 3)] for x, y in places]}, safe_distance_m = 0.2 }}
    """
    return parse_fleet(text.replace("\n                  ", " "), source="here")


@pytest.mark.slow
@pytest.mark.parametrize("made", [three(), ring(10)], ids=["3 and a reserve", "10"])
def test_an_agent_that_starts_again_is_told_the_mission_by_about_one_other(made: Fleet):
    """There is no commander any more."""
    bench = FleetBench(made)
    bench.drive()
    bench.restart(3)
    since = bench.now
    bench.said.clear()
    while bench.state(3) not in DRIVING:
        bench.step()
        assert bench.now - since < NS_PER_S
    bench.run(3.0)
    assert bench.state(3) is State.RUNNING
    told = [robot for robot, _ in bench.told(Mission)]
    assert told.count(3) == 1  # what it has learnt, once
    assert 1 <= len(told) - 1 <= 2
    assert not any(agent.rejected for agent in bench.agents.values())


def test_a_plant_that_missed_the_leave_is_told_it_by_its_agent():
    """Plants say of no orders which they know: an agent sees that its own does not obey."""
    bench = FleetBench(three())
    bench.drive()
    bench.say(STOP, Stop(1, bench.now, ""))
    bench.run(0.5)
    bench.cut = lambda _key, node: node is bench.plants[2] and _key != key_expressions.wrench("few", 2)
    bench.say(RESUME, Resume(2, bench.now, ()), [node for node in bench.nodes if node is not bench.plants[2]])
    bench.run(0.3)
    bench.cut = lambda _key, _node: False
    assert bench.plants[2].condition == ("braking", "stop")
    bench.run(1.0)
    assert bench.plants[2].condition == ("driving", "")


def test_who_asks_is_told_all():
    bench = FleetBench(three())
    bench.drive()
    bench.say(STOP, Stop(1, bench.now, ""))
    bench.say(RESUME, Resume(2, bench.now, ()))
    bench.run(1.0)
    bench.said.clear()
    bench.say(ASK, Ask(bench.now, "Ada"))
    bench.run(0.5)
    assert len(bench.told(Mission)) == len(bench.told(Stop)) == len(bench.told(Resume)) == 1


@pytest.mark.slow
def test_what_a_robot_learns_it_says_once_on_its_own_key_and_never_on_an_operators():
    """In its next tick, so that whoever hears this robot alone has it: a stop must not wait."""
    bench = FleetBench(three())
    bench.run(0.5)
    said = [
        (MISSION, bench.mission()),
        (STOP, Stop(1, bench.now, "here")),
        (RESUME, Resume(2, bench.now, ())),
    ]
    for key, message in said:
        before = bench.now
        bench.say(key, message)
        bench.run(0.04)
        told = [robot for robot, each in bench.told(type(message)) if each == message]
        assert sorted(told) == [1, 2, 3, 4]
        bench.run(3.0)
        on_it = [each for at, said_on, each in bench.said if said_on == key and at > before]
        assert on_it == []  # the operator said it at `before`
    assert len(bench.told(Mission)) <= 4 + 1  # one beacon that was on its way may ask for it once more


def test_an_order_goes_from_robot_to_robot_where_the_operator_reaches_one_only():
    bench = FleetBench(three())
    bench.drive()
    bench.say(STOP, Stop(1, bench.now, "here"), [bench.agents[2]])
    bench.run(0.1)
    assert all(agent.state in (State.STOPPING, State.STOPPED) for agent in bench.agents.values())
    assert {plant.condition for plant in bench.plants.values()} == {("braking", "stop: here")}


def test_a_robot_that_is_told_of_a_mission_hears_of_the_stop_first():
    """Whoever tells it, and whatever it has learnt last."""
    bench = FleetBench(three())
    bench.drive()
    bench.say(STOP, Stop(1, bench.now, "here"))
    bench.run(1.0)
    bench.said.clear()
    bench.restart(2)
    bench.run(2.0)
    bench.say(MISSION, bench.mission(version=9))
    bench.run(0.5)
    for robot in bench.fleet.ids:
        told = bench.sayings(key_expressions.relayed("few", robot))
        missions = [k for k, each in enumerate(told) if type(each) is Mission]
        assert missions or robot not in (1, 2, 3)
        assert all(type(told[k - 1]) is Stop for k in missions)
    assert bench.state(2) is State.STOPPED
    assert not any(message.brake is False for message in bench.wrenches(2) if type(message) is Wrench)


def two_of_one_version(bench: FleetBench) -> tuple[Mission, Mission]:
    first = bench.sayings(MISSION)[0]
    assert isinstance(first, Mission)
    from_ns = bench.now + NS_PER_S
    made = first._replace(version=2, from_ns=from_ns, blend_ns=NS_PER_S)
    wider, longer = (
        ((1, 0.0, 0.0), (2, 1.5, 0.0), (3, 0.0, 1.0)),
        ((1, 0.0, 0.0), (2, 1.0, 0.0), (3, 0.0, 1.5)),
    )
    edges = ((1, 2, 1.2), (1, 3, 1.2), (2, 3, 1.8))
    return made._replace(robots=wider, edges=edges), made._replace(robots=longer, edges=edges)


def last_missions(bench: FleetBench) -> set[Mission | None]:
    return {agent._situation.mission for agent in bench.agents.values()}


def test_two_operators_at_once_each_heard_by_some_end_in_one_state():
    bench = FleetBench(three())
    bench.drive()
    one, other = two_of_one_version(bench)
    for robot, agent in bench.agents.items():
        bench.say(MISSION, one if robot % 2 else other, [agent])
    bench.run(2.5)
    assert last_missions(bench) in ({one}, {other})
