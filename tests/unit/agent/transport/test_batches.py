"""What is heard in batches, and how long a process waits for them."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.batch import packed
from handfast.agent.transport.batches import PATIENCE_NS, SAID_NS, SINGLY_KEPT, STOOD_NS, Batches

NAME = "many"
ALL = key_expressions.beacon(NAME, "*")
BEACONS, HANDS = key_expressions.beacon_batch(NAME), key_expressions.hand_batch(NAME)
T0 = 10**18


def hand(robot: int) -> str:
    return key_expressions.hand(NAME, robot)


def beacon(robot: int) -> str:
    return key_expressions.beacon(NAME, robot)


def batches(*, hands: bool = False) -> Batches:
    return Batches(NAME, range(1, 31), T0, hands=hands)


def lasting(made: Batches, duration_s: float, step_s: float = 0.1) -> list[float]:
    """Looks as often as a loop does: when (s from T0) what is to be listened to changed."""
    found = []
    start_ns = made._looked_ns
    for k in range(1, round(duration_s / step_s) + 1):
        now_ns = start_ns + round(k * step_s * NS_PER_S)
        if made.look(now_ns):
            found.append(round((now_ns - T0) / NS_PER_S, 3))
    return found


def test_beacons_are_listened_to_in_batches_and_all_else_as_it_is_asked_for() -> None:
    asked = [hand(3), ALL, key_expressions.mission(NAME)]
    assert batches().instead_of(asked) == [hand(3), BEACONS, asked[2]]
    assert batches(hands=True).instead_of(asked) == [BEACONS, HANDS, asked[2]]


def test_who_listens_to_no_other_robots_gets_what_it_asks_for() -> None:
    """A plant wants its own agent's alone."""
    asked = [hand(3), key_expressions.wrench(NAME, 3)]
    assert batches(hands=True).instead_of(asked) == asked


def test_where_no_batches_come_each_robot_is_heard_by_itself_until_one_comes() -> None:
    made = batches(hands=True)
    asked = [hand(3), ALL]
    assert made.instead_of(asked) == [BEACONS, HANDS]
    assert lasting(made, 5.0) == [PATIENCE_NS / NS_PER_S]
    assert made.wants_each
    assert made.instead_of(asked) == [hand(3), ALL, BEACONS, HANDS]
    made.opened(BEACONS, packed([], 30)[0], made._looked_ns)
    assert lasting(made, 2.0) == [5.1]
    assert not made.wants_each


def test_batches_that_come_are_waited_for_again() -> None:
    made = batches()
    for _ in range(20):
        assert lasting(made, SAID_NS / NS_PER_S) == []
        made.opened(BEACONS, packed([], 30)[0], made._looked_ns)


def test_time_in_which_it_did_not_run_does_not_count() -> None:
    """In a crowd that stands all would else begin to hear each by itself."""
    made = batches()
    assert lasting(made, 40.0, step_s=10.0) == [30.0], "of each 10 s one"
    again = batches()
    assert lasting(again, 10.0, step_s=STOOD_NS / NS_PER_S) == [3.0]


def test_what_is_in_a_batch_comes_as_from_each_robot() -> None:
    made = batches()
    said = [(3, b"three"), (7, b"seven"), (3, b"again")]
    expected = [(beacon(3), b"three"), (beacon(7), b"seven"), (beacon(3), b"again")]
    assert made.opened(BEACONS, packed(said, 30)[0], T0) == expected


def test_of_hand_states_those_come_that_are_asked_for() -> None:
    made = batches(hands=True)
    made.instead_of([hand(3), hand(7), ALL])
    (batch,) = packed([(2, b"two"), (3, b"three"), (7, b"seven")], 30)
    assert made.opened(HANDS, batch, T0) == [(hand(3), b"three"), (hand(7), b"seven")]
    made.instead_of([hand(2), ALL])
    assert made.opened(HANDS, batch, T0) == [(hand(2), b"two")]


def test_no_hand_state_comes_twice() -> None:
    """From two routers that both take it to be their part, or by itself and in a batch: what was done to it
    on its way would be told twice, and a recording be said to have been changed."""
    made = batches(hands=True)
    asked = [hand(3), hand(7), ALL]
    made.instead_of(asked)
    first, second = [(3, b"one"), (7, b"one")], [(3, b"one"), (7, b"two")]
    assert made.opened(HANDS, packed(first, 30)[0], T0) == [(hand(3), b"one"), (hand(7), b"one")]
    assert made.opened(HANDS, packed(second, 30)[0], T0) == [(hand(7), b"two")]
    assert lasting(made, 5.0) == [PATIENCE_NS / NS_PER_S]
    made.instead_of(asked)
    assert made.opened(HANDS, packed([(3, b"three")], 30)[0], made._looked_ns) == []
    for each in (b"three", b"four"):
        made.came_singly(hand(7), each)
    said = [(5, b"five")]
    assert made.opened(BEACONS, packed(said, 30)[0], made._looked_ns) == [(beacon(5), b"five")]
    assert lasting(made, 0.1) == [5.1], "and yet it is a sign that a router makes batches"
    made.instead_of(asked)
    after = packed([(3, b"four"), (7, b"three"), (7, b"four")], 30)[0]
    assert made.opened(HANDS, after, made._looked_ns) == [(hand(3), b"four")]


def test_what_waited_in_a_router_that_stood_comes_once_and_is_not_remembered_for_ever() -> None:
    made = batches(hands=True)
    made.instead_of([hand(3), ALL])
    for _ in range(3):
        now_ns = made._looked_ns
        made.opened(BEACONS, packed([], 30)[0], now_ns)
        lasting(made, 4.0)
        assert made.wants_each
        waited = [(3, b"%d at %d" % (k, now_ns)) for k in range(SINGLY_KEPT)]
        for _, payload in waited:
            made.came_singly(hand(3), payload)
            made.came_singly(beacon(3), payload)
        made.came_singly(hand(3), b"one more than wait")
        made.opened(BEACONS, packed([], 30)[0], made._looked_ns)
        lasting(made, 0.1)
        assert made.opened(HANDS, packed(waited, 30)[0], made._looked_ns) == []
        assert {key: len(came) for key, came in made._singly.items()} == {hand(3): SINGLY_KEPT}


def test_what_is_no_batch_comes_as_it_is_and_is_no_sign_of_a_router() -> None:
    made = batches()
    assert made.opened(BEACONS, b"junk", T0 + 10**9) == [(BEACONS, b"junk")]
    assert lasting(made, 4.0) == [PATIENCE_NS / NS_PER_S]


def test_of_robots_that_the_fleet_does_not_have_nothing_is_taken() -> None:
    said = [(31, b"made up"), (30, b"thirty"), (0, b"")]
    assert batches().opened(BEACONS, packed(said, 30)[0], T0) == [(beacon(30), b"thirty")]
