"""A new mission on its way: who has acknowledged it, and whether another one was quicker."""

from __future__ import annotations

from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import Mission, Status
from handfast.deploy.orders.mission_outcome import Ordering, words
from tests.unit.deploy.orders.order_fleets import EPOCH, S, after, first_plan, order, square

FLEET = square()
MISSION, _ = after(order("join", robot=7, edges=(2, 3), over_s=2.0), first_plan(FLEET), FLEET, 4.0, 50)


def statuses(version: int = MISSION.version, **other: int) -> dict[int, Status]:
    found = dict.fromkeys(FLEET.ids, version) | {int(key[1:]): each for key, each in other.items()}
    return {
        robot: Status(robot, 1, EPOCH, "running", "why not", "", each, 0, (), (), (), ())
        for robot, each in found.items()
    }


def test_what_is_changed_and_when() -> None:
    assert words(MISSION) == "robot 7 joins (edges to 2 and 3): at 5.0 s, over 2.0 s"
    assert words(Mission(1, EPOCH, EPOCH, S, "", 0, 0, "as it was")) == "as it was: at 0.0 s"


def test_done_when_all_know() -> None:
    made = Ordering(MISSION, FLEET.ids)
    assert not made.look(FLEET.ids, {}, MISSION)
    assert not made.look(FLEET.ids, statuses(r3=1), MISSION)
    assert not made.done
    every = len(FLEET.ids)
    lacking = [f"{every - 1} of {every} acknowledged", "robot 3: has not taken it: running"]
    assert made.outcomes() == lacking, "nobody else is named"
    assert made.look(FLEET.ids, statuses(), MISSION)
    assert made.done
    assert made.outcomes() == [f"{every} of {every} acknowledged"]


def test_who_is_not_there_is_named_and_not_waited_for() -> None:
    made = Ordering(MISSION, FLEET.ids)
    there = [robot for robot in FLEET.ids if robot != 3]
    assert made.look(there, statuses(r3=1), MISSION)
    assert not made.done
    assert made.outcomes()[1] == "robot 3: its agent is not there; the others will relay it"
    assert not made.look([], {}, MISSION), "nobody is there as yet"


def test_who_was_removed_is_not_waited_for_unless_it_is_there() -> None:
    removed, _ = after(order("remove", robots=(3,)), first_plan(FLEET), FLEET, 4.0, 60)
    there = [robot for robot in FLEET.ids if robot != 3]
    made = Ordering(removed, FLEET.ids)
    assert made.look(there, statuses(60, r3=1), removed)
    assert made.done
    others = len(there)
    assert made.outcomes() == [f"{others} of {others} acknowledged", "robot 3: has been removed"]
    assert not made.look(FLEET.ids, statuses(60, r3=1), removed), "it is back, and has not taken it"
    assert not made.done
    assert made.outcomes()[1] == "robot 3: has not taken it: running"
    made.look([robot for robot in there if robot != 4], statuses(60), removed)
    assert not made.done


def test_one_of_a_greater_version_may_have_been_made_of_it() -> None:
    """Told that it was not done people scaled a fleet twice."""
    made = Ordering(MISSION, FLEET.ids)
    assert made.look(FLEET.ids, statuses(r2=MISSION.version + 1), MISSION)
    assert made.overruled
    assert not made.done
    assert made.outcomes() == [
        "overtaken by another operator's order, maybe on top of it; look before ordering again"
    ]
    later = MISSION._replace(version=MISSION.version + 1, note="robot 4 leaves")
    made.look(FLEET.ids, statuses(r2=later.version), later)
    assert "overtaken by another operator's order (robot 4 leaves)" in made.outcomes()[0]


def test_of_equal_versions_the_one_that_holds_everywhere_was() -> None:
    others = (MISSION._replace(note=f"robot {number} joins") for number in range(9, 99))
    other = next(each for each in others if newer(each, MISSION))
    made = Ordering(MISSION, FLEET.ids)
    made.look(FLEET.ids, statuses(), other)
    assert made.outcomes() == [
        f"not done: another operator's order was quicker ({other.note}); look, and order again"
    ]
    winner = Ordering(other, FLEET.ids)
    winner.look(FLEET.ids, statuses(), MISSION)
    assert winner.done
    restamped = Ordering(MISSION, FLEET.ids)
    restamped.look(FLEET.ids, statuses(), MISSION._replace(time_ns=EPOCH + 7))
    assert restamped.done
