"""What an agent says of itself: on which keys, with which numbers, and when it is its turn."""

from __future__ import annotations

from handfast.agent.control.controller import Controller
from handfast.agent.control.hand import Hand
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import MissionChoice
from handfast.agent.messages.codec import decode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import HEARD_ROUNDS, Beacon, HandState, Setpoint, Wrench
from handfast.agent.supervision.orders import StopLatch
from handfast.agent.supervision.outbox import Outbox
from tests.unit.agent.agent_bench import BEACON, HAND, PERIOD, START, WRENCH, fleet

HERE = Hand(1.0, 2.0, 0.5, -0.5)
TICK = START + PERIOD // 2


def outbox() -> Outbox:
    made = fleet()
    latch = StopLatch(1, lambda: None)
    peers = Controller(made, resolve(made), 1).peers
    return Outbox(made, 1, PERIOD // 2, peers, MissionChoice(made, resolve(made)), latch)


def test_numbers_count_rounds_from_the_epoch_for_wrench_hand_and_beacon_alike():
    box = outbox()
    box.begin(START)
    for rounds in range(3):
        now_ns = TICK + rounds * PERIOD
        [(key, payload)], (wrench_key, wrench) = (
            box.hand(now_ns, HERE, 0.0, following=True),
            box.wrench(now_ns),
        )
        assert (key, wrench_key) == (HAND, WRENCH)
        hand, asked = decode(payload), decode(wrench)
        assert isinstance(hand, HandState)
        assert isinstance(asked, Wrench)
        assert (hand.sequence, asked.sequence) == (FIRST_ROUND + rounds,) * 2
        for _, said in box.beacon(now_ns, HERE, 0.0, following=True):
            beacon = decode(said)
            assert isinstance(beacon, Beacon)
            assert beacon.sequence == hand.sequence


def test_a_hand_state_holds_what_it_is_given():
    forces = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    [(_, payload)] = outbox().hand(
        TICK, HERE, 0.25, following=True, degree=3, forces=forces, multipliers=((2, 0.5),), own=(7.0,)
    )
    hand = decode(payload)
    assert isinstance(hand, HandState)
    assert (hand.place, hand.doubt, hand.degree) == (tuple(HERE), 0.25, 3)
    assert (hand.navigation_x, hand.constraint_y, hand.correction_y) == (1.0, 4.0, 6.0)
    assert (hand.multipliers, hand.own) == (((2, 0.5),), (7.0,))


def test_both_say_what_a_body_goes_on_by_that_nothing_commands_any_more():
    obeys = (Setpoint(0.5, 0.8, -0.25),)
    box = outbox()
    [(_, payload)] = box.hand(TICK, HERE, 0.0, following=True, obeys=obeys)
    hand = decode(payload)
    assert isinstance(hand, HandState)
    assert hand.obeys == obeys
    said = [
        decode(payload)
        for rounds in range(20)
        for _, payload in box.beacon(TICK + rounds * PERIOD, HERE, 0.0, following=True, obeys=obeys)
    ]
    assert said
    for beacon in said:
        assert isinstance(beacon, Beacon)
        assert beacon.obeys(1) == obeys
        assert beacon.obeys(2) == ()
        assert beacon.lost == ()


def test_both_say_for_how_long_a_body_has_been_lost():
    obeys = (Setpoint(0.5, 0.8, -0.25),)
    box = outbox()
    [(_, payload)] = box.hand(TICK, HERE, 1.7, following=False, obeys=obeys, lost_ms=520)
    hand = decode(payload)
    assert isinstance(hand, HandState)
    assert hand.lost_ms == 520
    said = [
        decode(payload)
        for rounds in range(20)
        for _, payload in box.beacon(
            TICK + rounds * PERIOD, HERE, 1.7, following=False, obeys=obeys, lost_ms=520
        )
    ]
    assert said
    for beacon in said:
        assert isinstance(beacon, Beacon)
        assert (beacon.lost_ms(1), beacon.lost_ms(2)) == (520, 0)


def test_a_wrench_brakes_or_asks():
    box = outbox()
    asked, brake = decode(box.wrench(TICK, 3.0, -1.0)[1]), decode(box.wrench(TICK + PERIOD, brake=True)[1])
    assert isinstance(asked, Wrench)
    assert isinstance(brake, Wrench)
    assert (asked.force, asked.torque, asked.brake) == (3.0, -1.0, False)
    assert (brake.force, brake.torque, brake.brake) == (0.0, 0.0, True)


def test_beacons_come_five_times_a_second_and_echoes_once_in_seven_rounds():
    box = outbox()
    ticks = [TICK + k * PERIOD for k in range(50 * HEARD_ROUNDS)]
    beacons = [each for now_ns in ticks for each in box.beacon(now_ns, HERE, 0.0, following=False)]
    assert {key for key, _ in beacons} == {BEACON}
    assert len(beacons) == len(ticks) // 10


def test_at_a_lower_rate_it_says_when_the_next_hand_state_comes_and_beacons_go_on():
    box = outbox()
    box.begin(START)
    box.keep_pace(4 * PERIOD)
    asked = decode(box.wrench(TICK, 3.0, 1.0)[1])
    assert isinstance(asked, Wrench)
    assert asked.step == 2
    box.overload = 2
    beacons = []
    for rounds in range(0, 200, 4):
        now_ns = TICK + rounds * PERIOD
        hand = decode(box.hand(now_ns, HERE, 0.0, following=True)[0][1])
        assert isinstance(hand, HandState)
        assert (hand.sequence, hand.next_ms) == (FIRST_ROUND + rounds, 4 * PERIOD // 1_000_000)
        beacons += [decode(said) for _, said in box.beacon(now_ns, HERE, 0.0, following=True)]
    assert 19 <= len(beacons) <= 21  # five a second
    assert {beacon.overload for beacon in beacons if isinstance(beacon, Beacon)} == {2}
    box.keep_pace(4 * PERIOD, promise_ns=10 * PERIOD)
    hand = decode(box.hand(TICK + 196 * PERIOD, HERE, 0.0, following=False)[0][1])
    assert isinstance(hand, HandState)
    assert hand.next_ms == 10 * PERIOD // 1_000_000
    box.keep_pace(PERIOD)
    hand = decode(box.hand(TICK + 200 * PERIOD, HERE, 0.0, following=True)[0][1])
    assert isinstance(hand, HandState)
    assert hand.next_ms == 0
