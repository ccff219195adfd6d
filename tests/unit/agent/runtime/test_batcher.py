"""What a router passes on in batches, when, and which of several does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.batch import EACH_MAX, unpacked
from handfast.agent.runtime.batcher import AT, LATE_AT, Batcher
from handfast.agent.transport.batches import SAID_NS

NAME = "many"
T0 = 10**18
BEACONS, HANDS = key_expressions.beacon_batch(NAME), key_expressions.hand_batch(NAME)


def fleet(hosts: int = 0, robots: int = 30) -> Fleet:
    """At 10 Hz; on `hosts` hosts, or on this machine."""
    lines = ["[fleet]", f'name = "{NAME}"', "rate_hz = 10.0", "[network]", 'topology = "routed"']
    lines += ['routers = ["h0"]'] if hosts else []
    lines += ["[formation]", "edges = [[1, 2]]", "safe_distance_m = 0.2", "distance_m = 2.0"]
    lines += ["[avoidance]", "beacon_interval_max_s = 1.6"]
    for host in range(hosts):
        lines += [f"[host.h{host}]", f'address = "10.0.0.{host + 1}"']
    for k in range(robots):
        lines += ["[[robot]]", f"id = {k + 1}", f"x_m = {2 * k}", "y_m = 0"]
        lines += [f'host = "h{k % hosts}"'] if hosts else []
    return parse_fleet("\n".join(lines), source="here")


class Tokens:
    def __init__(self) -> None:
        self.alive: set[str] = set()

    def update(self) -> None:
        pass


class Client:
    """One of a router that gives what was put into `came`, and keeps what is published."""

    def __init__(self, name: str = "5", others: Sequence[str] = ()) -> None:
        self.name = name
        self.tokens = Tokens()
        self.tokens.alive = {key_expressions.router_alive(NAME, other) for other in others}
        self.came: list[tuple[str, bytes]] = []
        self.sent: list[tuple[str, bytes]] = []
        self.declared: list[str] = []
        self.listened: Sequence[str] = ()

    def listen(self, subscriptions: Sequence[str]) -> None:
        self.listened = subscriptions

    def drain(self) -> Sequence[tuple[str, bytes]]:
        came, self.came = self.came, []
        return came

    def declare(self, key: str) -> None:
        self.declared.append(key)

    def publish(self, key: str, payload: bytes) -> None:
        assert key in self.declared
        self.sent.append((key, payload))

    def announce(self, key: str) -> None:
        self.tokens.alive.add(key)

    def watch(self, key: str, is_known: Callable[[str], object]) -> Tokens:
        assert is_known(key_expressions.router_alive(NAME, "7")) == "7"
        assert is_known(key_expressions.alive(NAME, 7, "agent")) is None
        return self.tokens


def beacon(robot: int) -> str:
    return key_expressions.beacon(NAME, robot)


def hand(robot: int) -> str:
    return key_expressions.hand(NAME, robot)


class Bench:
    def __init__(self, made: Fleet | None = None, client: Client | None = None) -> None:
        self.fleet, self.client = made or fleet(), client or Client()
        self.batcher = Batcher(self.fleet, self.client, T0)
        self.next()

    def next(self, *came: tuple[str, bytes]) -> tuple[float, list[tuple[str, list[tuple[str, bytes]]]]]:
        """At which part of the period after agents' ticks it is due next, and what it sends then."""
        self.client.came += came
        now_ns, self.client.sent = self.batcher.due_ns, []
        self.batcher.look(now_ns)
        at = (now_ns / self.fleet.period_ns - 0.5) % 1.0
        ids = self.fleet.ids
        keys = {BEACONS: {r: beacon(r) for r in ids}, HANDS: {r: hand(r) for r in ids}}
        sent = [(key, unpacked(each, len(ids), keys[key])) for key, each in self.client.sent]
        return round(at, 3), sent


def test_what_robots_say_in_a_round_goes_out_once_before_the_next() -> None:
    bench = Bench(fleet(hosts=2))
    assert bench.client.listened == [beacon("*")]
    for _ in range(3):
        came = [(beacon(3), b"three"), (beacon(7), b"seven")]
        assert bench.next(*came) == (AT, [(BEACONS, came)])
        assert bench.next() == (AT, [])


def test_of_robots_that_share_a_machine_hand_states_too_and_those_of_loops_that_were_late() -> None:
    bench = Bench()
    assert bench.client.listened == [beacon("*"), hand("*")]
    if bench.batcher.due_ns % bench.fleet.period_ns != bench.batcher._phase_ns:
        bench.next()
    said, late = [(hand(3), b"three"), (beacon(3), b"3")], [(hand(7), b"seven"), (beacon(7), b"7")]
    assert bench.next(*said) == (AT, [(BEACONS, said[1:]), (HANDS, said[:1])])
    assert bench.next(*late) == (LATE_AT, [(HANDS, late[:1])])
    assert bench.next() == (AT, [(BEACONS, late[1:])])


def test_where_nothing_is_said_an_empty_batch_says_that_it_is_there() -> None:
    bench = Bench()
    begun_ns, empty = bench.batcher.due_ns, []
    while bench.batcher.due_ns < begun_ns + 3 * NS_PER_S:
        at_ns = bench.batcher.due_ns
        _, sent = bench.next()
        assert sent in ([], [(BEACONS, [])])
        empty += [at_ns] if sent else []
    gaps = [b - a for a, b in pairwise(empty)]
    assert gaps
    assert all(SAID_NS <= gap <= SAID_NS + bench.fleet.period_ns for gap in gaps)


def test_nothing_is_looked_at_before_it_is_due_nor_for_ever_not_when_the_clock_was_set_back() -> None:
    bench = Bench(fleet(hosts=2))
    due_ns = bench.batcher.due_ns
    bench.client.came, bench.client.sent = [(beacon(1), b"one")], []
    bench.batcher.look(due_ns - 1)
    assert not bench.client.sent
    bench.batcher.look(due_ns - 3600 * NS_PER_S)
    assert bench.client.sent
    assert bench.batcher.due_ns <= due_ns - 3600 * NS_PER_S + bench.fleet.period_ns


def test_what_is_not_the_fleets_is_not_passed_on() -> None:
    bench = Bench(fleet(hosts=2))
    assert bench.next((beacon(31), b"made up"), (key_expressions.status(NAME, 3), b""))[1] == []


def test_a_robot_that_floods_takes_no_batch_away() -> None:
    """`Bench.next` reads each as an agent does, which refuses one that holds too much."""
    bench = Bench(fleet(hosts=2))
    flood = [(beacon(1), b"")] * (3 * EACH_MAX * 30)
    _, sent = bench.next(*flood, (beacon(2), b"two"))
    assert sum(len(said) for _, said in sent) == len(flood) + 1
    assert sent[-1][1][-1] == (beacon(2), b"two")


@pytest.mark.parametrize(("name", "leads"), [("3", True), ("9", False)])
def test_of_several_routers_the_one_with_the_least_name(name: str, leads: bool) -> None:
    bench = Bench(fleet(hosts=2), Client(name, others=["5", "7"]))
    assert bool(bench.client.listened) is leads
    assert bool(bench.next((beacon(1), b"one"))[1]) is leads


def test_when_that_goes_it_is_the_next() -> None:
    bench = Bench(fleet(hosts=2), Client("9", others=["5"]))
    assert bench.next((beacon(1), b"one"))[1] == []
    bench.client.tokens.alive.discard(key_expressions.router_alive(NAME, "5"))
    assert bench.next((beacon(1), b"two"))[1] == [(BEACONS, [(beacon(1), b"two")])]
    bench.client.tokens.alive.add(key_expressions.router_alive(NAME, "5"))
    assert bench.next((beacon(1), b"three"))[1] == []
    assert bench.client.listened == []
