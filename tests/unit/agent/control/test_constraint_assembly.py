"""What a robot has to keep at one tick: whose half planes there are, and which come first."""

from __future__ import annotations

from math import cos, hypot, pi, sin
from typing import Any

import pytest

from handfast.agent.control.constraint_assembly import STOP_S, ConstraintAssembly, Scene
from handfast.agent.control.controller import Controller
from handfast.agent.control.hand import Hand, Pose
from handfast.agent.control.limits import barrier_rate
from handfast.agent.control.peers.beliefs import DOUBT_MAX, Run, stood_on
from handfast.agent.control.peers.rolling import STOPS_S, Rolls, arc, middle, rolled
from handfast.agent.control.safety_filter import SEPARATION, STANDING, UNSURE, HalfPlane, project
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.types import HandState

S = 1_000_000_000
T0 = 1000 * S
FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 5, y_m = 5 }, { id = 3, x_m = 0, y_m = 5 }]
fleet = { name = "three" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0], [0, 9]], safe_distance_m = 0.2 }
"""
ROVERS = f"""{FLEET}
datum = {{ latitude_deg = 50.0, longitude_deg = 8.0 }}
robot_defaults = {{ plant = "mavlink", mavlink = {{ connection = "simulator" }} }}
"""


class Robot:
    """Robot 1, its hand in (0.1, 0), which has heard robot 3 at `T0`, `away` m ahead, and coming so fast."""

    def __init__(
        self,
        away: float,
        *,
        follows: bool = True,
        doubt: float = 0.0,
        coming: float = 0.0,
        deaf: bool = False,
        text: str = FLEET,
    ) -> None:
        fleet = parse_fleet(text, source="here")
        self.barrier_rate = barrier_rate(fleet)
        self.controller = Controller(fleet, resolve(fleet), 1)
        self.controller.look(T0)
        self.peers, self.proximity = self.controller.peers, self.controller.proximity
        state = HandState(3, 0, T0, follows, 2, 0.1 + away, 0.0, -coming, *[0.0] * 7, doubt, (), ())
        assert self.peers.accept(state, T0 + fleet.period_ns) is None
        self.peers.get(3).deaf = deaf
        self.assembly = ConstraintAssembly(fleet, 1, self.peers, self.proximity, self.controller.right_of_way)

    def scene(self, now_ns: int, speed: float = 0.0) -> Scene:
        """What it has to keep while it drives along the x axis."""
        own = Hand(0.1, 0.0, speed, 0.0)
        self.controller.look(now_ns)
        self.proximity.look(now_ns, own, (2,))
        scene = Scene(now_ns, own, 0.0, 0.0, None)
        self.assembly.find(scene, now_ns, self.controller.edges, 1.0)
        return scene


@pytest.mark.parametrize(
    ("follows", "doubt", "rank", "text"),
    [
        (True, 0.0, SEPARATION, FLEET),
        (True, DOUBT_MAX, UNSURE, FLEET),
        (False, 0.0, STANDING, FLEET),
        (False, DOUBT_MAX, STANDING, FLEET),
        (False, 1.5, STANDING, FLEET),
        (False, DOUBT_MAX, STANDING, ROVERS),
        (False, 1.5, UNSURE, ROVERS),
    ],
)
def test_who_stands_comes_first_and_who_may_be_anywhere_last(
    follows: bool, doubt: float, rank: int, text: str
) -> None:
    scene = Robot(0.4, follows=follows, doubt=doubt, text=text).scene(T0 + S // 10)
    (plane,) = (each for each in scene.planes if each.cause == "robot 3")
    assert plane.rank == rank


@pytest.mark.parametrize(("speed", "let"), [(0.3, True), (-0.3, False)])
def test_beside_the_way_of_a_silent_robot_it_may_drive_off_it_however_long_that_is(
    speed: float, let: bool
) -> None:
    """Robot 3 went by, 0.3 m behind robot 1, and is on one of several stretches: only the nearest one says
    what is away from it."""
    robot = Robot(-0.3)
    robot.peers.get(3).belief = stood_on([(0.5 * k, -0.2, 0.4 * k - 1.2) for k in range(7)], 0.0)
    scene = robot.scene(T0 + 10 * S, speed)
    assert len({(plane.nx, plane.ny) for plane in scene.planes if plane.cause == "robot 3"}) > 3
    assert [each[:3] for each in scene.within] == [(1.0, pytest.approx(0.0), "robot 3")]
    assert (not scene.stops) is let
    assert all(plane.least <= 0.0 for plane in scene.planes) is let


@pytest.mark.parametrize(("since_s", "flees"), [(1.0, False), (2.4, True), (2.9, True), (3.7, False)])
def test_from_where_a_vehicle_rolls_that_nobody_hears_it_gets_away_and_not_only_stops(
    since_s: float, flees: bool
) -> None:
    """It comes at robot 1, turning, with nobody to brake it, until its own watchdog does."""
    robot = Robot(3.0, coming=1.0, text=ROVERS)
    heading, speed, yaw_rate = 2.7, 1.0, 0.3
    peer = robot.peers.get(3)
    assert peer.message is not None
    peer.message = peer.message._replace(obeys=((heading, speed, yaw_rate),))
    peer.note_way(peer.message)
    there = rolled(peer.message.x, peer.message.y, (heading, speed, yaw_rate), 0.1, since_s)
    planes = [each for each in robot.scene(T0 + round(since_s * S)).planes if each.cause == "robot 3"]
    away = -there.x + 0.1, -there.y
    pushes = [each for each in planes if each.rank == UNSURE and each.least > 0.0]
    assert bool(pushes) is flees
    if flees:
        (plane,) = pushes
        assert plane.nx == pytest.approx(away[0] / hypot(*away), abs=1e-6)


def test_from_one_that_is_known_to_be_lost_it_gets_away_as_from_what_is_known_and_off_its_way() -> None:
    """Robot 2 is heard a second later: robot 3 has fallen silent alone, and rolls on past robot 1."""
    robot = Robot(1.0, coming=0.5, text=ROVERS)
    peer = robot.peers.get(3)
    assert peer.message is not None
    peer.message = peer.message._replace(y=0.15, obeys=((pi, 0.5, 0.0),))
    peer.note_way(peer.message)
    later = HandState.placed(2, 1, T0 + S, True, 1, (5.0, 5.0, 0.0, 0.0))
    assert robot.peers.accept(later, T0 + S + S // 10) is None
    planes = [each for each in robot.scene(T0 + round(1.45 * S)).planes if each.cause == "robot 3"]
    ahead, beside = (each for each in planes if each.least > 0.0)
    assert ahead.rank == beside.rank == SEPARATION
    assert ahead.nx < -0.8, "from where it is now"
    assert beside.ny < min(-0.7, ahead.ny - 0.2), "rather off its way"


HERE = Pose(-0.3, 0.0, 0.0, 0.0, 0.0)
"""The own body: it stands, and its hand is in (0.1, 0)."""


def lost_ahead(robot: Robot, *, silent: bool) -> None:
    """Robot 3 rolls at robot 1, as nothing commands it: it fell silent alone, or its agent says so."""
    peer = robot.peers.get(3)
    assert peer.message is not None
    peer.message = peer.message._replace(obeys=((pi, 0.9, 0.0),))
    peer.note_way(peer.message)
    if silent:
        later = HandState.placed(2, 1, T0 + S, True, 1, (5.0, 5.0, 0.0, 0.0))
        assert robot.peers.accept(later, T0 + S + S // 10) is None
        return
    way = arc(peer.message.x, peer.message.y, (pi, 0.9, 0.0), Rolls(3.0 + STOPS_S, 0.1))
    place, obeys = (*middle(way), 0.0, 0.0), ((pi, 0.9, 0.0),)
    said = HandState.placed(3, 20, T0 + S, False, 0, place, 1.8, obeys, 1000)
    assert robot.peers.accept(said, T0 + S + S // 10) is None


@pytest.mark.parametrize("silent", [True, False])
def test_it_gets_out_of_the_way_of_one_that_rolls_at_it_faster_than_it_could_go_back(silent: bool) -> None:
    robot = Robot(3.0, coming=0.9, text=ROVERS)
    lost_ahead(robot, silent=silent)
    scene = robot.scene(T0 + round(1.3 * S))
    asked = robot.assembly.dodge(scene, HERE)
    assert asked is not None
    assert asked[1] != 0.0 or asked[0] < 0.0
    assert robot.assembly.evades == "gets out of the way of robot 3, which nothing commands"
    assert not [plane for plane in scene.planes if plane.cause == "robot 3"], (
        "else it would be held in front of it"
    )


def test_where_something_else_is_in_its_way_it_keeps_from_both() -> None:
    robot = Robot(3.0, coming=0.9, text=ROVERS)
    lost_ahead(robot, silent=True)
    scene = robot.scene(T0 + round(1.3 * S))
    before = list(scene.planes)
    scene.planes.extend(HalfPlane(cos(k), sin(k), -0.1, "wall") for k in range(7))
    assert robot.assembly.dodge(scene, HERE) is None
    assert scene.planes[: len(before)] == before


def test_one_that_is_told_to_roll_elsewhere_is_no_reason_to_move() -> None:
    robot = Robot(3.0, coming=-0.9, text=ROVERS)
    peer = robot.peers.get(3)
    assert peer.message is not None
    peer.message = peer.message._replace(obeys=((0.0, 0.9, 0.0),))
    peer.note_way(peer.message)
    later = HandState.placed(2, 1, T0 + S, True, 1, (5.0, 5.0, 0.0, 0.0))
    assert robot.peers.accept(later, T0 + S + S // 10) is None
    assert robot.assembly.dodge(robot.scene(T0 + round(1.3 * S)), HERE) is None
    assert robot.assembly.evades == ""


@pytest.mark.parametrize(("text", "seen"), [(FLEET, False), (ROVERS, True)])
def test_one_that_may_have_rolled_near_is_kept_from_though_it_says_a_place_far_away(
    text: str, seen: bool
) -> None:
    robot = Robot(3.5, follows=False, doubt=3.0, text=text)
    assert robot.proximity.sensing < 3.5
    planes = [each for each in robot.scene(T0 + S // 10, 0.3).planes if each.cause == "robot 3"]
    assert bool(planes) is seen


LATE_NS = S // 2
BESIDE_A_POLE = (
    FLEET.replace("[0, 9]", "[-3, 0]")
    + """
[[obstacle]]
centre_m = [-0.2, 0.0]
radius_m = 0.15
"""
)
"""Robot 1 is as near to the pole as it may be: clearance and margin, 0.10 and 0.05 m. The place of robot 3 is
on the other side of both."""


def late(**more: Any) -> Robot:
    """It comes at robot 1, its messages always take `LATE_NS`, and so it is heard."""
    robot = Robot(0.4, coming=0.3, text=BESIDE_A_POLE, **more)
    robot.peers.get(3).lateness.forgiven_ns = LATE_NS
    return robot


@pytest.mark.parametrize(
    ("more", "ranks"),
    [
        ({}, [UNSURE, SEPARATION]),
        ({"deaf": True}, [SEPARATION]),
        ({"follows": False}, [STANDING]),
        ({"doubt": DOUBT_MAX}, [UNSURE]),
    ],
)
def test_of_one_that_is_known_late_only_braking_is_asked_with_what_is_known(
    more: dict[str, bool | float], ranks: list[int]
) -> None:
    """But the whole of one that does not keep away by itself."""
    speed = 0.1
    robot = late(**more)
    planes = [each for each in robot.scene(T0 + LATE_NS, speed).planes if each.cause == "robot 3"]
    assert [each.rank for each in planes] == ranks
    brakes = robot.barrier_rate * speed
    assert planes[0].least > brakes + 0.1
    assert [each.least for each in planes[1:]] == [pytest.approx(brakes)] * (len(ranks) - 1)


def test_one_that_is_known_late_does_not_press_it_against_an_obstacle() -> None:
    scene = late().scene(T0 + LATE_NS)
    (pole,) = (each for each in scene.planes if each.cause == "obstacle 1")
    assert pole.least == pytest.approx(0.0)
    u = project(0.0, 0.0, scene.planes, 5.0)
    assert u.causes == ("robot 3", "obstacle 1")
    assert u.violation > 0.1
    assert pole.nx * u.ux + pole.ny * u.uy == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("age_ns", [S // 10, 2 * LATE_NS])
@pytest.mark.parametrize("speed", [0.1, 0.4])
def test_one_that_stands_is_not_driven_at_because_its_place_is_further_on(age_ns: int, speed: float) -> None:
    """It is predicted to go there, and cannot: others stand before it."""
    robot = Robot(0.26, text=FLEET.replace("[0, 9]", "[9, 0]"))
    robot.peers.get(3).lateness.forgiven_ns = 2 * LATE_NS
    scene = robot.scene(T0 + age_ns, speed)
    known = [each for each in scene.planes if each.cause == "robot 3" and each.rank == SEPARATION]
    assert max(-each.nx * each.least for each in known) >= robot.barrier_rate * speed - 1e-9


@pytest.mark.parametrize(("away", "pressed"), [(0.45, True), (0.24, False)])
def test_nobody_is_pressed_over_a_body_that_is_not_heard(away: float, pressed: bool) -> None:
    """How far it is off its way is a guess, and gives way to what is known; its way is not driven over."""
    robot = Robot(-away)
    robot.peers.get(3).belief = stood_on([(0.0, 0.1 - away, -1.0), (4.0, 0.1 - away, 1.0)], 0.0)
    speed = -0.1
    planes = robot.scene(T0 + 10 * S, speed).planes
    planes.append(HalfPlane(-1.0, 0.0, 0.5, "robot 2"))
    u = project(0.0, 0.0, planes, 5.0)
    assert (u.ux < 0.0) is pressed
    if not pressed:
        assert u.ux == pytest.approx(-speed / STOP_S, abs=1e-6)


def test_back_to_its_own_lane_a_robot_does_not_drive_over_one_that_it_hears() -> None:
    """Lanes are where others may be; robot 3 is there, between robot 1 and its own lane."""
    robot = Robot(0.26)
    lane = (2.0, -5.0, 0.0, 10.0, 0.01)
    robot.controller.right_of_way.keep_in = ((Run(2.0, 0.0, 5.0, (lane,)),),)
    scene = robot.scene(T0 + S // 10)
    ranks = [(each.rank, each.least > 0.0) for each in scene.planes if each.cause == "own lane"]
    assert sorted(ranks) == [(SEPARATION, False), (UNSURE, True)]
    u = project(0.0, 0.0, scene.planes, 5.0)
    known = [each for each in scene.planes if each.rank == SEPARATION]
    assert all(each.nx * u.ux + each.ny * u.uy > each.least - 1e-6 for each in known)
