"""Who goes on and who waits where robots that cannot hear each other may meet."""

from __future__ import annotations

from math import hypot

import pytest

from handfast.agent.control.hand import Hand
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.right_of_way import GAINED_NS, LANE_SHARE, RightOfWay
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve, start_hand
from handfast.agent.formation.mission_plan import plan_of
from handfast.agent.formation.reference import Reference
from handfast.agent.messages.codec import Mark, tag
from handfast.agent.messages.types import Beacon, Mission, Silent

SAFE = 0.2
FLEET = """
robot = [
  { id = 1, x_m = -6, y_m = 0, hand_offset_m = 0.1 }, { id = 2, x_m = -6, y_m = 1.5, hand_offset_m = 0.1 },
  { id = 3, x_m = 6, y_m = 1.5, hand_offset_m = 0.1 }, { id = 4, x_m = 6, y_m = 0, hand_offset_m = 0.1 },
  { id = 5, x_m = 0, y_m = 9, hand_offset_m = 0.1, reserve = true },
]
fleet = { name = "across" }
formation = { edges = [[1, 2], [2, 3], [3, 4]], offsets = [[6, 0], [6, 1.5], [-6, 1.5], [-6, 0]], \
safe_distance_m = 0.2 }
control = { prediction_horizon_s = 1.0 }
"""
S = 1_000_000_000
T0 = 1000 * S
PERIOD = 20_000_000


class Scene:
    """Robot `robot` at its start, all others heard there at the epoch, standing ready."""

    def __init__(self, robot: int, *overrides: str, text: str = FLEET) -> None:
        self.fleet = parse_fleet(text, source="here", overrides=overrides)
        self.robot, self.now = robot, T0
        geometry = resolve(self.fleet)
        self.reference = Reference(self.fleet, geometry)
        mission = Mission(1, 0, T0, 60 * S, "")
        self.reference.take(plan_of(mission, self.fleet, geometry))
        self.marks = dict.fromkeys(self.fleet.ids, (1, tag(mission)))
        self.told = 0, 0
        control = self.fleet.control
        self.starts = {each.id: start_hand(each) for each in self.fleet.robots}
        self.peers = Peers(
            robot, control.c1, control.c2, PERIOD, self.reference.instant,
            decay=0.5, most=control.max_speed_mps,
            starts={other: at for other, at in self.starts.items() if other != robot},
            horizon_s=control.prediction_horizon_s,
        )  # fmt: skip
        self.peers.forecast.epoch_ns = T0
        self.peers.begin(T0)
        self.references: dict[Mark, Reference] = {self.marks[robot]: self.reference.frozen()}
        self.way = RightOfWay(self.fleet, robot, self.peers, self.reference, self.references)
        self.here = Hand(*self.starts[robot], 0.0, 0.0)
        self.hear(*self.starts)

    def hear(self, *robots: int, unheard: tuple[int, ...] = ()) -> None:
        for robot in robots:
            if robot != self.robot:
                place = *self.starts[robot], 0.0, 0.0, 0.0
                told = Beacon(robot, 0, self.now, True, *place, *self.marks[robot], -1, -1, (), unheard)
                assert self.peers.accept_beacon(told, self.now + PERIOD) is None

    def hear_seldom(self, *robots: int, now: int) -> None:
        """They say now that they say it again 0.9 s later."""
        for robot in robots:
            place = *self.starts[robot], 0.0, 0.0, 0.0
            told = Beacon(robot, 0, now, True, *place, *self.marks[robot], -1, -1, next_ms=900)
            assert self.peers.accept_beacon(told, self.now + PERIOD) is None

    def run(self, seconds: float, *robots: int, unheard: tuple[int, ...] = ()) -> None:
        """Only `robots` are heard from now on, who say from whom they hear nothing."""
        for _ in range(round(seconds / 0.1)):
            self.now += S // 10
            self.hear(*robots, unheard=unheard)
            self.look()

    def look(self, *, rests: bool = False, passing: bool = False) -> None:
        now_ns, mark = self.now + PERIOD, self.marks[self.robot]
        if mark != self.told:
            self.told = mark
            self.way.told(now_ns, self.here, mark)
        self.way.look(now_ns, self.here, rests=rests, passing=passing)

    def move(self, x: float, y: float, vx: float = 0.0, vy: float = 0.0) -> None:
        self.here = Hand(x, y, vx, vy)

    @property
    def names(self) -> list[str]:
        return [each.name for each in self.way.keep_out]

    def floor(self, nx: float, ny: float) -> float:
        """Least acceleration along (nx, ny) that the planes demand."""
        planes = list(self.way.planes(self.here))
        return max((p.least for p in planes if p.nx * nx + p.ny * ny > 0.99), default=-9.0)


def test_while_all_are_heard_nothing_is_looked_at():
    scene = Scene(4)
    scene.run(5.0, 1, 2, 3, 5)
    assert (scene.way.hold, scene.way.keep_out, scene.way.keep_in) == ("", (), ())
    assert list(scene.way.planes(scene.here)) == []


def test_one_silent_robot_alone_cannot_drive_and_has_no_lane():
    """Nobody who shares an edge with it says that it hears it: it stands."""
    scene = Scene(4)
    scene.run(5.0, 1, 3, 5)
    assert (scene.way.hold, scene.names, scene.way.keep_in) == ("", [], ())


@pytest.mark.parametrize(("robot", "heard"), [(1, (2, 5)), (4, (3, 5)), (1, (2,)), (4, (3,))])
def test_more_than_half_or_the_half_with_the_lowest_id_go_on(robot: int, heard: tuple[int, ...]):
    """Of five robots, one in reserve: three are more than half. Of four, two are half."""
    scene = Scene(robot)
    if len(heard) == 1:
        scene.peers.get(5).gone_ns = T0 + 100 * S  # there are four
    scene.run(5.0, *heard)
    goes_on = len(heard) == 2 or robot == 1
    if goes_on:
        assert scene.way.hold == ""
        assert scene.names == []
        assert scene.way.keep_in
    else:
        assert scene.way.hold.startswith("on the lane of robot 1, which has the right of way (silent for ")


def test_who_speaks_seldom_counts_once_it_has_been_heard_since_the_others_were_lost():
    """Robots 2, 3 and 5 are cut off at once. That 3 and 5 are is not known yet when 2 is given up."""
    heard_since, not_yet = (
        Scene(1, "avoidance.beacon_interval_max_s=1.0"),
        Scene(1, "avoidance.beacon_interval_max_s=1.0"),
    )
    for scene in (heard_since, not_yet):
        scene.now += S // 20
        scene.hear_seldom(3, 5, now=scene.now)
        scene.now += S // 20
        scene.hear(2)
        scene.run(1.1)
        if scene is heard_since:
            scene.hear_seldom(3, 5, now=scene.now)
        scene.run(0.3)
        assert {2, 4} <= set(scene.peers.given_up(scene.now))
        assert not {3, 5} & set(scene.peers.given_up(scene.now))
    assert heard_since.way.hold == ""
    assert not_yet.way.hold != "" or not_yet.names


def test_who_has_no_right_of_way_stays_out_of_the_lanes_of_the_others_and_in_its_own():
    scene = Scene(3)
    scene.peers.get(5).gone_ns = T0 + 100 * S
    scene.move(6.0, 3.2)
    scene.run(5.0, 4)
    assert scene.way.hold == ""
    assert scene.names == ["lane of robot 2"]
    assert scene.way.keep_in
    apart = (LANE_SHARE + 1.0) * SAFE + scene.fleet.avoidance.margin_m
    scene.move(5.0, 1.5 + apart + 0.05, 0.0, -0.5)
    scene.run(0.1, 4)
    assert scene.floor(0.0, 1.0) > 0.5  # it is braked
    scene.move(5.0, 1.5 + apart - 0.02)
    scene.run(0.1, 4)
    assert "on the lane" not in scene.way.hold
    scene.move(5.0, 1.5 + 0.1)
    scene.run(0.1, 4)
    assert "on the lane of robot 2" in scene.way.hold


def test_outside_its_lane_who_has_the_right_of_way_keeps_out_of_the_others():
    scene = Scene(1)
    scene.run(0.2, 2, 5)
    scene.move(-2.0, 5.5)  # far from the line along which it drives
    scene.run(5.0, 2, 5)
    assert scene.way.hold == ""
    assert "lane of robot 3" not in scene.names
    scene.move(-2.0, 2.4)
    scene.run(0.1, 2, 5)
    assert "lane of robot 3" in scene.names
    scene.move(-2.0, 1.6)
    scene.run(0.1, 2, 5)
    assert scene.way.hold.startswith("on the lane of robot 3 (silent for ")


def test_at_the_edge_of_its_lane_it_is_braked():
    scene = Scene(4)
    scene.peers.get(5).gone_ns = T0 + 100 * S
    scene.move(6.0, -1.6)
    scene.run(0.2, 3)
    scene.run(4.0, 3)
    own = scene.way.keep_in
    assert own
    half = LANE_SHARE * SAFE - scene.fleet.avoidance.margin_m
    run = own[0][0]
    scene.move(6.0 - 0.0, -1.6 - half + 0.01, 0.0, -0.4)
    scene.run(0.1, 3)
    assert hypot(run.x - 6.0, run.y + 1.6) < 20.0
    assert scene.floor(0.0, 1.0) > 0.5


def test_whom_the_others_do_not_hear_is_not_counted():
    """Robots 2 and 5 are heard, but hear nothing of robot 4."""
    scene = Scene(4)
    scene.run(5.0, 2, 5, unheard=(4,))
    assert scene.way.hold.startswith("on the lane of robot 1")


def blind(scene: Scene, seconds: float, *robots: int, knows_s: float) -> None:
    """These robots are heard and do not hear robot 1, of which they know that it was at its start so long ago
    (s); the others hear it."""
    for _ in range(round(seconds / 0.1)):
        scene.run(0.1, *(robot for robot in (2, 3, 4, 5) if robot not in robots))
        for robot in robots:
            row = Silent(
                1, scene.now - round(knows_s * S), True, *scene.starts[1], 0.0, 0.0, *scene.starts[1], 0.0
            )
            place = *scene.starts[robot], 0.0, 0.0, 0.0
            told = Beacon(robot, 0, scene.now + 1, True, *place, *scene.marks[robot], -1, -1, (row,), (1,))
            assert scene.peers.accept_beacon(told, scene.now + PERIOD) is None
        scene.look()


def test_who_is_heard_and_has_given_this_one_up_is_as_one_that_is_not_heard():
    """It looks for this one on the lane that it knows, and drives through where that does not lead."""
    scene = Scene(1)
    blind(scene, 3.0, 3, 4, knows_s=0.3)  # somebody tells them of it
    assert (scene.way.hold, scene.way.keep_in) == ("", ())
    blind(scene, 3.0, 3, 4, knows_s=1.5)
    assert scene.way.keep_in
    assert scene.way.hold == ""
    scene.run(0.5, 2, 3, 4, 5)  # they hear it again
    assert (scene.way.hold, scene.way.keep_in) == ("", ())
    blind(scene, 3.0, 3, 4, knows_s=1.5)
    for robot in (3, 4):  # their bodies have been carried off since
        scene.peers.get(robot).gone_ns = scene.now + 100 * S
    scene.run(0.5, 2, 5)
    assert (scene.way.hold, scene.way.keep_in) == ("", ())
    few = Scene(1)
    blind(few, 3.0, 2, 3, 4, knows_s=1.5)
    assert few.way.hold == "on the lane of robot 4, which has the right of way (does not hear this one)"


def test_without_the_right_of_way_it_keeps_to_its_lane_wherever_the_others_lanes_are():
    """Who has it may have left its own, and is anywhere but near this one's."""
    scene = Scene(3, text=FLEET.replace("[-6, 1.5], [-6, 0]]", "[6, 6], [6, 9]]"))
    scene.peers.get(5).gone_ns = T0 + 100 * S
    scene.move(6.0, 5.0)
    scene.run(5.0, 4)
    assert scene.names == []
    assert scene.way.keep_in


def test_one_that_has_started_in_mid_drive_and_is_not_heard_holds():
    """The others mean the lane from before its start, which it does not know."""
    for began_ns, holds in ((T0 - S, False), (T0 + S, True)):
        scene = Scene(1)
        scene.peers._began_ns = began_ns
        scene.run(0.5, 2, 3, 4, 5, unheard=(1,))
        scene.run(3.0, 2, 5)
        assert (scene.way.hold == "not heard since it started by robot 3, robot 4") is holds


def test_the_right_of_way_that_is_gained_begins_later():
    scene = Scene(4)
    scene.run(5.0, 3)
    assert scene.way.hold
    scene.run(GAINED_NS / S - 0.2, 3, 5)
    assert scene.way.hold
    scene.run(0.5, 3, 5)
    assert scene.way.hold == ""


def test_before_it_drives_it_need_not_know_where_others_might():
    scene = Scene(4)
    for _ in range(50):
        scene.now += S // 10
        scene.hear(3)
        scene.look(rests=True)
    assert (scene.way.hold, scene.way.keep_out, scene.way.keep_in) == ("", (), ())
    scene.run(0.1, 3)
    assert scene.way.hold
    scene.run(GAINED_NS / S - 0.2, 3, 5)  # whom it did not hear counts as ever
    assert scene.way.hold


def test_heard_again_all_is_as_it_was():
    scene = Scene(4)
    scene.run(5.0, 3)
    assert scene.way.hold
    scene.run(0.1, 1, 2, 3, 5)
    assert (scene.way.hold, scene.names, scene.way.keep_in) == ("", [], ())


def test_lanes_are_those_of_the_mission_that_the_silent_have_acknowledged():
    """Robots 1 and 2 have another mission meanwhile, of which 3 and 4 have not heard: their old lanes count,
    and so does the own one, for that is what they keep out of."""
    scene = Scene(1)
    scene.run(1.0, 2, 3, 4, 5)
    robots = ((1, 6.0, 5.0), (2, 6.0, 6.5), (3, -6.0, 6.5), (4, -6.0, 5.0))
    other = Mission(
        2, scene.now, T0, 60 * S, "", from_ns=scene.now, robots=robots, edges=((1, 2, 1.5), (3, 4, 1.5))
    )
    scene.reference.take(plan_of(other, scene.fleet, resolve(scene.fleet)))
    scene.run(5.0, 2, 5)
    assert scene.way.keep_in
    (run, *_) = scene.way.keep_in[0]
    assert abs(run.y) < 0.5  # along y = 0, as before, though its place is at (6, 5)
    scene.move(-2.0, 2.4)
    scene.run(0.1, 2, 5)
    assert "lane of robot 3" in scene.names  # at y = 1.5
    scene.move(-2.0, 5.7)
    scene.run(0.1, 2, 5)
    assert (scene.way.hold, scene.names) == ("", [])


@pytest.mark.parametrize("knew", [True, False])
def test_a_robot_that_was_replaced_drives_with_nobody_who_has_left_its_mission(knew: bool):
    """Robot 3 falls silent, robot 5 takes its place, then 4 falls silent, which shared an edge with 3 before.
    Has 4 not heard of the change, the two may be driving by what was."""
    scene = Scene(1)
    scene.run(9.0, 2, 4, 5)
    assert scene.way.keep_in == ()
    robots = ((1, 6.0, 0.0), (2, 6.0, 1.5), (5, -6.0, 1.5), (4, -6.0, 0.0))
    edges = ((1, 2, 1.5), (2, 5, 12.0), (4, 5, 1.5))
    changed = Mission(2, scene.now, T0, 60 * S, "", from_ns=scene.now, robots=robots, edges=edges)
    scene.reference.take(plan_of(changed, scene.fleet, resolve(scene.fleet)))
    for robot in (2, 5, *((4,) if knew else ())):
        scene.marks[robot] = 2, tag(changed)
    scene.run(0.5, 2, 4, 5)
    scene.run(5.0, 2, 5)
    assert bool(scene.way.keep_in) is not knew


def test_the_own_lane_is_that_from_where_each_of_the_silent_heard_it():
    """Robot 3 was lost long before 4: what each of them knows is where this one was then."""
    scene = Scene(1)
    scene.run(0.5, 2, 3, 4, 5)
    scene.run(20.0, 2, 4, 5)
    scene.move(-2.0, 0.1)
    scene.run(3.0, 2, 4, 5)
    scene.run(5.0, 2, 5)
    lanes = {peer: ways.own for peer, ways in scene.way._ways.items()}
    assert lanes[3].distance(-6.0, 0.0) < 0.2
    assert lanes[4].distance(-2.0, 0.1) < 0.05
    assert lanes[4].distance(-6.0, 0.0) > 3.0
