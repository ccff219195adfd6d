"""What the live view says of a fleet, besides where its robots are."""

from __future__ import annotations

import io
from contextlib import suppress

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Beacon, Faults, HandState, Mission, Silent, Status
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.drive.display.live_view import Lines, make_view
from handfast.deploy.drive.display.picture_wording import faults_line, summary
from handfast.deploy.drive.watch import Picture, RobotPicture, Watch
from tests.screen import screen_lines

EPOCH_NS = 1_800_000_000 * NS_PER_S


def fleet(more: str = "") -> Fleet:
    return parse_fleet((FLEETS / "pair.toml").read_text() + more, source="pair")


def watch(more: str = "") -> Watch:
    made = fleet(more)
    watched = Watch(made, resolve(made))
    watched.feed(key_expressions.mission("pair"), Mission(1, EPOCH_NS, EPOCH_NS, 60 * NS_PER_S, digest(made)))
    return watched


def status(robot: int, offset_us: int, error_us: int) -> Status:
    neighbour = (3 - robot, 20_000, 10, 0, offset_us, error_us)
    return Status(robot, 1, EPOCH_NS, "running", "", "", 1, 0, (neighbour,), (), (), ())


def live(time_s: float, rules: str, lease_ns: int = 0) -> Faults:
    now_ns = EPOCH_NS + round(time_s * NS_PER_S)
    return Faults(7, now_ns, "ana@lab:3211", now_ns, lease_ns, rules)


LOSS = '[[faults.rule]]\nlink = "1->2"\nloss = "30%"\n'


def test_faults_that_hold_are_named_with_their_end() -> None:
    watched = watch(
        '[[faults.rule]]\nname = "cut"\npartition = "1 | 2"\nat = 5\nfor = 5\n'
        '[[faults.rule]]\nname = "again"\nrobot = 2\nrestart = "agent"\nat = 5\n'
        '[[faults.rule]]\nlink = "1->2"\ndelay = "5ms"\n'
    )
    assert watched.picture(None).faults == ["rule 3"]
    assert watched.picture(4.9).faults == ["rule 3"]
    assert watched.picture(5.0).faults == ["cut until 10.0 s", "rule 3"]
    assert watched.picture(10.0).faults == ["rule 3"]


def test_live_faults_are_named_with_their_author() -> None:
    watched = watch()
    watched.feed(key_expressions.faults_held("pair", 2, "agent"), live(3.0, LOSS, 2 * NS_PER_S))
    assert watched.picture(2.9).faults == []
    picture = watched.picture(4.0)
    assert faults_line(picture) == "faults: live loss 30% on 1->2 (ana@lab:3211)"
    assert watched.picture(5.0).faults == [], "its lease has run out"


def at(robot: int, x: float, y: float) -> HandState:
    return HandState.placed(robot, 1, EPOCH_NS, True, 0, (x, y, 0.0, 0.0))


def told(watched: Watch, robot: int, state: str, reason: str, after_ns: int) -> None:
    status = Status(robot, 1, EPOCH_NS + after_ns, state, "", reason, 1, 0, (), (), (), ())
    watched.feed(key_expressions.status("pair", robot), status)


def test_a_released_robot_is_shown_with_its_reason() -> None:
    watched = watch()
    told(watched, 1, "running", "", 1)
    told(watched, 2, "released", "mode MANUAL, not GUIDED", 1)
    text = summary(watched.picture(1.0))
    assert text.endswith("running: 1, released: 2 (mode MANUAL, not GUIDED)")
    told(watched, 1, "released", "disarmed", 2)
    text = summary(watched.picture(1.0))
    assert text.endswith("released: 1 (disarmed), 2 (mode MANUAL, not GUIDED)")


def test_a_robot_that_stands_before_the_missions_end_is_news_whatever_the_file_says() -> None:
    watched = watch()
    told(watched, 2, "running", "", 1)
    watched.news(1.0)
    told(watched, 2, "stopped", "stop: a person", 2)
    at_s = 59.0
    assert fleet().fleet.duration_s < at_s
    assert watched.news(at_s) == ["59.0 s: robot 2 is stopped: stop: a person"]


def test_an_agent_that_is_gone_says_nothing_until_it_is_back() -> None:
    watched = watch()
    told(watched, 2, "running", "", 1)
    watched.forget(2)
    for robot in (1, 2):
        watched.feed(key_expressions.hand("pair", robot), hand(robot, float(robot), 0.0))
    assert watched.picture(1.0).worst is not None
    watched.forget(1)  # of which no status was heard yet
    assert watched.picture(1.0).worst is None
    assert watched.picture(1.0).robots[2].state == ""
    assert watched.states() == {1: "", 2: ""}
    told(watched, 2, "ready", "for a mission", 2)
    assert watched.states() == {1: "", 2: "ready"}


def test_a_body_that_was_removed_is_near_nobody_until_its_robot_is_heard() -> None:
    watched = watch()
    told(watched, 2, "running", "", 1)
    for robot in (1, 2):
        watched.feed(key_expressions.hand("pair", robot), hand(robot, 0.1 * robot, 0.0))
    assert watched.picture(1.0).nearest is not None
    since_ns = watched.hands[2].time_ns
    mission = Mission(
        9, since_ns, since_ns + 1, NS_PER_S, digest(fleet()), note="robot 2 has been removed",
        robots=((1, 0.0, 0.0),), removed=((2, since_ns),),
    )  # fmt: skip
    watched.feed(key_expressions.mission("pair"), mission)
    assert watched.news(5.0)[0] == "5.0 s: robot 2 has been removed"
    picture = watched.picture(5.0)
    assert picture.nearest is None
    assert picture.robots[2].reason == "has said nothing for 4 s, and its body has been removed"
    watched.feed(key_expressions.hand("pair", 2), hand(2, 0.2, 0.0)._replace(time_ns=since_ns + 1))
    assert watched.picture(5.0).nearest is not None
    assert watched.picture(5.0).robots[2].state == "running"


def hand(robot: int, x: float, y: float) -> HandState:
    return HandState(robot, 1, EPOCH_NS, True, 1, x, y, *[0.0] * 9, (), ())


def test_the_picture_is_of_the_edges_in_force() -> None:
    """A mission of anybody changes what distances are measured against, when it is taken over."""
    made = fleet()
    watched = Watch(made, resolve(made))
    wanted = float(resolve(made).distances[0])
    assert watched.picture(None).worst is None, "nothing is heard yet"
    for robot, x in ((1, 0.0), (2, wanted + 0.25)):
        watched.feed(key_expressions.hand("pair", robot), hand(robot, x, 0.0))
    worst = watched.picture(None).worst
    assert worst is not None
    assert worst == (pytest.approx(0.25), 1, 2)
    longer = Mission(
        1,
        EPOCH_NS,
        EPOCH_NS,
        60 * NS_PER_S,
        digest(made),
        EPOCH_NS + 5 * NS_PER_S,
        2 * NS_PER_S,
        "longer",
        0,
        (),
        ((1, 0.0, 0.0), (2, wanted + 0.25, 0.0)),
        ((1, 2, wanted + 0.25),),
    )
    watched.feed(key_expressions.mission("pair"), longer)

    def picture(at_s: float) -> Picture:
        for robot, x in ((1, 0.0), (2, wanted + 0.25)):
            again = hand(robot, x, 0.0)._replace(time_ns=EPOCH_NS + round(at_s * NS_PER_S))
            watched.feed(key_expressions.hand("pair", robot), again)
        return watched.picture(at_s)

    errors = [found.worst[0] for at_s in (4.0, 6.0, 8.0) if (found := picture(at_s)).worst]
    assert errors == [pytest.approx(0.25), pytest.approx(0.125), pytest.approx(0.0)]
    told(watched, 1, "running", "", 1)
    assert picture(8.0).robots[1].error_m == pytest.approx(0.0)
    fading = longer._replace(version=2, from_ns=EPOCH_NS + 9 * NS_PER_S, edges=())
    watched.feed(key_expressions.mission("pair"), fading)
    assert picture(8.9).worst is not None
    assert watched.picture(9.2).worst is None, "it is on its way out"


def test_robots_in_reserve_are_shown() -> None:
    watched = watch("[[robot]]\nid = 9\nx_m = 5\ny_m = 5\nreserve = true\n")
    for robot in (1, 2):
        told(watched, robot, "running", "", 1)
    told(watched, 9, "standby", "in reserve", 1)
    assert watched.states() == {1: "running", 2: "running", 9: "standby"}
    assert summary(watched.picture(1.0)).endswith("running: 1, 2, standby: 9")


def test_a_robot_that_falls_silent_is_shown_so_with_its_body() -> None:
    """Its last words do not hold any more: the other says where it is."""
    watched = watch()
    row = Silent(2, EPOCH_NS, True, 0.6, -0.4, 0.0, 0.0, 0.6, -0.4, 0.0)
    told(watched, 2, "running", "", 1)
    for second in range(1, 6):
        after_ns = second * NS_PER_S
        told(watched, 1, "degraded", "without robot 2", after_ns)
        said = Beacon(1, 1, EPOCH_NS + after_ns, True, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 0, -1, -1, (row,), (2,))
        watched.feed(key_expressions.beacon("pair", 1), said)
        picture = watched.picture(float(second))
        silent = second > 2  # its status came with the first of these pictures
        assert (picture.robots[2].state == "silent") == silent
    assert picture.robots[2].reason == "has said nothing for 4 s"
    assert picture.robots[1].state == "degraded"
    stream = io.StringIO()
    Lines(stream, quiet=False, period_s=2.0).show(picture)
    assert (
        stream.getvalue()
        .rstrip()
        .endswith(
            "degraded: 1, silent: 2, not heard: robot 2 for 5 s (not by robot 1), believed at (0.60, -0.40)"
        )
    )


def test_nothing_is_shown_of_a_fleet_of_which_nobody_is_heard() -> None:
    """As while the router stands through which all comes: what was said last does not hold any more."""
    watched = watch()
    for robot, x in ((1, 0.0), (2, 1.0)):
        told(watched, robot, "running", "", 1)
        watched.feed(key_expressions.hand("pair", robot), at(robot, x, 0.3))
    assert summary(watched.picture(1.0)).startswith("worst edge "), "they are heard"
    picture = watched.picture(6.0)
    assert picture.worst is picture.nearest is picture.oldest_ms is None
    assert {about.off_m for about in picture.robots.values()} == {None}
    assert summary(picture) == "all silent (nothing heard for 5 s)"
    told(watched, 2, "running", "", 2)
    picture = watched.picture(6.5)
    assert picture.nearest is not None, "from one that is heard to where the other was"
    assert picture.oldest_ms is not None


class Tty(io.StringIO):
    """A terminal, as far as what is written to it goes."""

    def isatty(self) -> bool:
        return True


def moving(time_s: float, count: int) -> Picture:
    robots = {
        robot: RobotPicture(
            *("degraded", "held up by robot 1", 0.1, 40.0, 90, 0),
            off_m=time_s,
            nearest=(1.0, 1),
            speed=0.5,
        )
        for robot in range(1, count + 1)
    }
    return Picture(time_s, 9.0, (1.0, 1, 2), (0.1, 1, 2), robots, ["live loss 30% on 1->2 (ana@lab:3211)"])


@pytest.mark.parametrize("width", [60, 80, 140])
@pytest.mark.parametrize("height", [8, 40])
@pytest.mark.parametrize("interrupted", [False, True])
def test_the_last_table_stays_once_and_whole(
    monkeypatch: pytest.MonkeyPatch, width: int, height: int, interrupted: bool
) -> None:
    for name, value in (("TERM", "xterm"), ("COLUMNS", str(width)), ("LINES", str(height))):
        monkeypatch.setenv(name, value)
    stream = Tty()
    with suppress(KeyboardInterrupt), make_view(stream) as view:
        for second in range(1, 6):
            view.show(moving(float(second), count=12))
            view.say(f"said at {second}")
        if interrupted:
            raise KeyboardInterrupt
    stream.write("PASSED\n")
    text = stream.getvalue()
    lines = screen_lines(text, width)
    assert lines[:5] == [f"said at {second}" for second in range(1, 6)]
    assert max(map(len, lines)) <= width
    table = lines[5:-2]
    assert table[0].startswith("drove ")
    assert table[0].endswith("5.0 of 9 s")
    (heading,) = (number for number, line in enumerate(table) if line.startswith("robot  state"))
    rows = [line.split()[:3] for line in table[heading + 1 :]]
    assert rows == [[str(robot), "degraded", "5.00"] for robot in range(1, 13)]
    assert lines[-2:] == ["PASSED", ""]
    assert sum("of 9 s" in line for line in lines) == 1
    assert (" more (" in text) == (height == 8), "robots for which there is no room are counted"
    # No drawing is higher than the terminal: what has left it at the top cannot be erased.
    drawings = text.split("driving")[1:]
    assert all(drawing.partition("\r")[0].count("\n") < height for drawing in drawings)
