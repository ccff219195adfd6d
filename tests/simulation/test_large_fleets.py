"""Fleets that are larger than what waits for a tick on one key."""

from __future__ import annotations

from collections import Counter
from math import sqrt

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Ask, Beacon, Mission, Resume, Stop
from handfast.deploy.analysis.shapes import lattice as driving_lattice
from handfast.deploy.simulate.simulation import Simulation

SIDE = 9


def lattice() -> str:
    """A square lattice of robots that stand at their places."""
    places = [(float(k % SIDE), float(k // SIDE)) for k in range(SIDE * SIDE)]
    robots = ", ".join(f"{{ id = {k}, x_m = {x}, y_m = {y} }}" for k, (x, y) in enumerate(places, 1))
    edges = [
        [i + 1, j + 1]
        for i in range(len(places))
        for j in range(i + 1, len(places))
        if abs(places[i][0] - places[j][0]) + abs(places[i][1] - places[j][1]) < sqrt(2)
    ]
    return f"""
robot = [{robots}]
fleet = {{ name = "many", rate_hz = 10, duration_s = 2 }}
formation = {{ edges = {edges}, offsets = {[list(place) for place in places]}, safe_distance_m = 0.2 }}
"""


def driven(fleet: Fleet) -> tuple[Simulation, list[Beacon]]:
    """A whole drive, and the beacons of all."""
    said: list[Beacon] = []

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        if key.endswith("/beacon"):
            message = decode(payload)
            assert isinstance(message, Beacon)
            said.append(message)

    simulation = Simulation(fleet, sink)
    simulation.run()
    return simulation, said


@pytest.mark.slow
def test_every_robot_hears_the_beacons_of_all_others() -> None:
    """Once they know the mission 81 of them say one in two ticks: some 40 at a time, while others of the same
    tick come already. Then less often, but as often as they must."""
    fleet = resolved(parse_fleet(lattice(), source="here"))
    simulation = Simulation(fleet)
    simulation.run()
    for agent in simulation.agents:
        ages_ns = {peer.robot: simulation.now_ns - peer.direct_ns for peer in agent._peers.known}
        assert len(ages_ns) == len(fleet.ids) - 1
        assert max(ages_ns.values()) < fleet.beacon_rounds_max * fleet.period_ns + NS_PER_S // 10, ages_ns


def test_that_agents_tick_rarely_before_a_mission_makes_no_link_late() -> None:
    """What waits for the own tick is no older on its link. Else who falls silent in the first seconds of a
    drive would be forgiven more, and all would look where ways meet of those whose messages are late."""
    simulation = Simulation(resolved(parse_fleet(driving_lattice("many", 30, duration_s=1.0), source="here")))
    periods: set[int] = set()

    def look(_: float) -> bool:
        periods.update(agent.period_ns for agent in simulation.agents)
        return True

    simulation.run(look)
    assert periods == {NS_PER_S // 10, 2 * NS_PER_S // 5}
    for agent in simulation.agents:
        peers = agent._peers
        assert {
            peer.robot: peer.lateness.forgiven_ns for peer in peers.known if peer.listened
        } == dict.fromkeys(peers.listened, 0)


@pytest.mark.slow
def test_nor_while_they_drive_and_they_do_not_speak_all_at_once() -> None:
    """They begin together, in the tick of the mission, and pass each other on their ways to their places."""
    fleet = resolved(parse_fleet(driving_lattice("many", 60, duration_s=5.0), source="here"))
    simulation, said = driven(fleet)
    driving = [beacon for beacon in said if beacon.time_ns > simulation.epoch_ns]
    assert {beacon.robot for beacon in driving} == set(fleet.ids)
    assert not any(beacon.silent or beacon.unheard for beacon in driving)
    begun_ns = simulation.epoch_ns + 2 * NS_PER_S
    settled = Counter(each.time_ns for each in driving if begun_ns < each.time_ns < begun_ns + 2 * NS_PER_S)
    assert max(settled.values()) < 4.0 * settled.total() / (2.0 * fleet.fleet.rate_hz)


@pytest.mark.slow
def test_that_all_take_an_order_is_no_news_and_one_answer_of_many_is_enough() -> None:
    """A resume once threw a fleet of 100 into overload: all told all of it at once, and again, and all
    answered the operator who asked for the orders before it gave it."""
    orders = "".join(
        f'\n[[order]]\nat = {at}\nkind = "{kind}"\n' for at, kind in ((4.0, "stop"), (7.0, "resume"))
    )
    fleet = resolved(parse_fleet(driving_lattice("many", 60, duration_s=9.0) + orders, source="here"))
    told: list[tuple[float, type]] = []
    begun_ns = [0]

    def sink(time_ns: int, key: str, payload: bytes) -> None:
        if begun_ns[0] and key.endswith(("/beacon", "/told")):
            told.append(((time_ns - begun_ns[0]) / NS_PER_S, type(decode(payload))))

    def of(since_s: float, until_s: float, *kinds: type) -> int:
        return sum(since_s <= at < until_s and kind in kinds for at, kind in told)

    simulation = Simulation(fleet, sink)
    assert simulation.start(9 * NS_PER_S)
    begun_ns[0] = simulation.epoch_ns
    simulation.run_until(simulation.epoch_ns + 6 * NS_PER_S)
    asked_s = 6.0
    simulation.publish(key_expressions.ask(fleet.fleet.name), encode(Ask(simulation.now_ns, "Ada")))
    simulation.run_until(simulation.epoch_ns + 9 * NS_PER_S)
    robots = len(fleet.ids)
    assert of(4.0, 5.0, Stop) == robots, "a stop each tells at once, who hears nobody else may lack it"
    assert of(4.0, 4.5, Beacon) <= robots // 2
    assert 1 <= of(asked_s, asked_s + 0.9, Stop) <= robots // 4
    assert 1 <= of(asked_s, asked_s + 0.9, Mission) <= robots // 4
    assert 1 <= of(7.0, 8.0, Resume) <= robots // 4
    assert of(7.0, 8.0, Beacon) <= 2 * robots
