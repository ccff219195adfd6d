"""Whom and what a robot keeps away from without sharing an edge: who counts as close, and for how long."""

from __future__ import annotations

from math import hypot, inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.common.quantities import DISTANCE_MIN
from handfast.agent.control.controller import LOOK_PERIOD_NS
from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.beliefs import DOUBT_MAX, Belief, Stretch
from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.proximity import AHEAD_S, LOOK_MANY_NS, REST_MAX_NS, STAY_M, Proximity
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.mission_plan import plan_of
from handfast.agent.formation.reference import Instant
from handfast.agent.messages.types import Beacon, Mission

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1, y_m = 0 }, { id = 3, x_m = 5, y_m = 0 }]
fleet = { name = "few" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0], [0, 3]], safe_distance_m = 0.2 }
avoidance = { distance_m = 1.1 }
obstacle = [{ name = "shed", centre_m = [3, 3], radius_m = 0.5 }]
geofence = { points_m = [[-10, -10], [10, -10], [10, 10], [-10, 10]] }
"""
T0 = 1_000_000_000_000
S = 1_000_000_000
PERIOD = 20_000_000
HERE = Hand(0.0, 0.0, 0.0, 0.0)


class Scene:
    """Robot 1 at the origin, and what it hears of robot 3."""

    def __init__(self, *overrides: str) -> None:
        self.fleet: Fleet = parse_fleet(FLEET, source="here", overrides=overrides)
        self.peers = Peers(1, 0.4, 0.6, PERIOD, lambda _time: Instant((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), {}))
        self.proximity = Proximity(self.fleet, 1, self.peers)
        self.now = T0
        self.mission(Mission(1, 0, T0, S, ""))

    def mission(self, mission: Mission) -> None:
        self.proximity.plan(plan_of(mission, self.fleet, resolve(self.fleet)))

    def beacon(self, x: float, vx: float = 0.0, robot: int = 3, follows: bool = True) -> None:
        told = Beacon(robot, 0, self.now - PERIOD, follows, x, 0.0, vx, 0.0, 0.0, 0, 0, -1, -1)
        assert self.peers.accept_beacon(told, self.now) is None

    def look(self, here: Hand = HERE, neighbours: tuple[int, ...] = (2,)) -> bool:
        return self.proximity.look(self.now, here, neighbours)

    def wait(self, ns: int = LOOK_PERIOD_NS) -> None:
        self.now += ns

    @property
    def close(self) -> list[int]:
        return [peer.robot for peer in self.proximity.close]


def test_who_comes_within_the_sensing_region_is_close_and_stays_a_little_longer():
    scene = Scene()
    seen = []
    for x in (2.1, 1.9, 2.1, 2.0 + STAY_M + 0.1, 2.1):
        scene.beacon(x)
        changed = scene.look()
        seen.append((changed, scene.close))
        scene.wait()
    assert seen == [(False, []), (True, [3]), (False, [3]), (True, []), (False, [])]


def test_who_was_within_it_when_it_was_last_heard_is_listened_to_where_messages_are_late():
    """It may have stopped there: who drives at its heels cannot wait for rare beacons to know."""
    for late_s, close in ((0.8, True), (0.1, False)):
        scene = Scene()
        peer = scene.peers.get(3)
        peer.lateness.forgiven_ns = S
        told = Beacon(3, 0, scene.now - round(late_s * S), True, 1.8, 0.0, 4.0, 0.0, 0.0, 0, 0, -1, -1)
        assert scene.peers.accept_beacon(told, scene.now) is None
        peer.lateness.forgiven_ns = S
        scene.look(HERE._replace(vx=4.0))
        assert (scene.close == [3]) is close


def test_who_says_seldom_where_it_is_is_near_where_it_may_have_stood():
    """It was to drive past, and would be at x = 4 by now, but may have stopped at any place on its way."""
    for y, speed, close in ((0.2, 0.5, True), (0.2, -0.5, True), (0.7, 0.5, False), (0.7, 1.4, True)):
        scene = Scene()
        at = scene.now - 9 * S // 5
        told = Beacon(3, 0, at, True, -0.5, y, 2.5, 0.0, 0.0, 0, 0, -1, -1, next_ms=2000)
        assert scene.peers.accept_beacon(told, scene.now) is None
        scene.look(HERE._replace(vx=speed))
        assert (scene.close == [3]) is close, (y, speed)


@pytest.mark.patches
def test_in_a_large_fleet_where_a_silent_robot_may_be_is_only_found_out_where_it_could_be_near(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []
    scene = Scene("avoidance.beacon_interval_max_s=2.0")
    believed = scene.peers.whereabouts.belief

    def noted(peer: Peer) -> Belief | None:
        asked.append(peer.robot)
        return believed(peer)

    monkeypatch.setattr(scene.peers.whereabouts, "belief", noted)
    scene.beacon(9.0)
    for _ in range(15):
        scene.wait()
        scene.look()
    assert asked == [], "not within 1.5 s"
    for _ in range(25):
        scene.wait()
        scene.look()
    assert set(asked) == {3}


def test_who_says_that_it_goes_elsewhere_is_looked_at_again_at_once() -> None:
    scene = Scene()
    scene.beacon(2.9)
    assert not scene.look()
    assert scene.peers.get(3).far_until_ns > scene.now + LOOK_PERIOD_NS
    scene.wait()
    scene.beacon(2.9, vx=-2.0)
    assert scene.look()


def test_a_robot_that_is_not_heard_for_a_while_is_looked_for_in_a_wider_region():
    scene = Scene()
    scene.beacon(2.0 + 0.9 * DOUBT_MAX)
    assert not scene.look()
    scene.wait(60 * S)
    assert scene.look()


def test_between_beacons_a_robot_that_drives_goes_on():
    driving, braking = Scene(), Scene()
    driving.beacon(2.65, vx=-1.0)
    braking.beacon(2.65, vx=-1.0, follows=False)
    for scene, close in ((driving, [3]), (braking, [])):
        assert not scene.look()
        scene.wait(S // 5)
        scene.look()
        assert scene.close == close


@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("here", [False, True])
def test_nobody_is_forgotten_by_time(follows: bool, here: bool):
    scene = Scene()
    scene.beacon(1.0, follows=follows)
    scene.mission(Mission(2, 0, T0, S, "", robots=((1, 0.0, 0.0), (2, 1.0, 0.0)), edges=((1, 2, 1.0),)))
    scene.peers.present(3, here)
    for _ in range(5):
        scene.look()
        assert scene.close == [3]
        scene.wait(3600 * S)


# ---------------------------------------------------------------------- against the plain form of it


def plainly(of: Proximity, peers: Peers, peer: Peer, now_ns: int, here: Hand) -> tuple[bool, int]:
    """Whether a robot is near, and until when it rests, with all worked out whether it matters or not."""
    message, rests_ns = peer.message, peer.far_until_ns
    stood = lasts_s = inf
    if message is not None and peer.is_heard(now_ns):
        age_ns = now_ns + peer.clock.used_ns - peer.time_ns
        lasts_s = (UNSURE_NS + peer.lateness.forgiven_ns - age_ns) / S
        ahead_s = max(0.0, age_ns / S) if message.following else 0.0
        dx, dy = message.x + ahead_s * message.vx - here.x, message.y + ahead_s * message.vy - here.y
        vx, vy, reach = message.vx, message.vy, peer.doubt(now_ns)
        speed = hypot(vx - here.vx, vy - here.vy)
        if seldom := peers.is_seldom(peer):
            speed = max(speed, hypot(vx, vy), hypot(here.vx, here.vy))
        if age_ns > UNSURE_NS:
            if seldom:
                stood = hypot(dx, dy) - ahead_s * hypot(vx, vy)
                if stood < of._soon:
                    way = Stretch(message.x, message.y, ahead_s * vx, ahead_s * vy, 0.0, 0.0)
                    stood = way.distance(here.x, here.y)
            elif hypot(message.x - here.x, message.y - here.y) < of.sensing:
                return True, rests_ns
    else:
        if message is not None and of.is_large:
            age_s = max(0.0, (now_ns + peer.clock.used_ns - peer.time_ns) / S)
            away = hypot(message.x - here.x, message.y - here.y) - peer.doubt(now_ns)
            rest_s = (away - of.sensing - STAY_M) / of._closing - 0.5 * age_s - AHEAD_S
            if rest_s > 0.0:
                return False, now_ns + min(REST_MAX_NS, int(rest_s * S))
        belief = peers.whereabouts.belief(peer)
        if belief is None:
            return False, rests_ns
        dx, dy, reach = belief.x - here.x, belief.y - here.y, belief.reach
        vx = vy = 0.0
        speed = of._closing
    away = hypot(dx, dy)
    parting = (dx * (vx - here.vx) + dy * (vy - here.vy)) / max(away, DISTANCE_MIN)
    reach += of.sensing + (STAY_M if peer in of.close else 0.0)
    room = min(away, stood) - reach
    as_said_s = min(AHEAD_S, lasts_s, (room - speed * AHEAD_S) / (speed + of._turning))
    rest_s = max(room / of._closing - AHEAD_S, as_said_s)
    if rest_s > 0.0:
        rest_ns = min(REST_MAX_NS, int(rest_s * S))
        return False, now_ns + (max(rest_ns, LOOK_MANY_NS) if of.is_large else rest_ns)
    if stood < of._keep + of._until_seen_s * hypot(here.vx, here.vy):
        return True, rests_ns
    if away + min(0.0, parting) * AHEAD_S < reach:
        return True, rests_ns
    return False, now_ns + LOOK_MANY_NS if of.is_large else rests_ns


SPEEDS = st.one_of(st.just(0.0), st.floats(-4.0, 4.0))


@pytest.mark.slow
@settings(max_examples=300)
@given(
    large=st.booleans(),
    place=st.tuples(st.floats(-20.0, 20.0), st.floats(-6.0, 6.0)),
    velocity=st.tuples(SPEEDS, SPEEDS),
    own=st.tuples(SPEEDS, SPEEDS),
    follows=st.sampled_from((True, True, False)),
    doubt=st.sampled_from((0.0, 0.1, 0.9)),
    next_ms=st.sampled_from((1500, 0)),
    forgiven_ns=st.sampled_from((2 * S, S, 0)),
    age_ns=st.one_of(st.integers(1, S // 2), st.integers(1, 4 * S)),
    was_close=st.booleans(),
    here=st.sampled_from((True, True, True, False)),
)
def test_who_is_near_and_who_rests_until_when_is_what_the_plain_form_of_it_says(
    large: bool,
    place: tuple[float, float],
    velocity: tuple[float, float],
    own: tuple[float, float],
    follows: bool,
    doubt: float,
    next_ms: int,
    forgiven_ns: int,
    age_ns: int,
    was_close: bool,
    here: bool,
) -> None:
    """To the bit: others hear of who is near, and by when it is found."""
    scene = Scene(*(("avoidance.beacon_interval_max_s=2.0",) if large else ()))
    peer = scene.peers.get(3)
    if was_close:
        scene.beacon(1.0)
        scene.look()
        scene.wait(4 * S)
    told = Beacon(3, 0, scene.now - 1, follows, *place, *velocity, doubt, 0, 0, -1, -1, next_ms=next_ms)
    assert scene.peers.accept_beacon(told, scene.now) is None
    scene.wait(age_ns)
    peer.lateness.forgiven_ns = forgiven_ns
    scene.peers.present(3, here)
    hand = Hand(0.0, 0.0, *own)
    is_near, rests_ns = plainly(scene.proximity, scene.peers, peer, scene.now, hand)
    scene.look(hand)
    assert ((scene.close == [3]), peer.far_until_ns) == (is_near, rests_ns)
