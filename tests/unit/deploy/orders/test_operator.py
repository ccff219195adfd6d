"""An operator's orders: their versions, what they become, and when they are said again."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from handfast.agent.formation.geometry import resolve
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import AHEAD_US_MAX, decode
from handfast.agent.messages.trickle_timer import FIRST_ROUND
from handfast.agent.messages.types import Ask, Beacon, Heartbeat, Mission, PlantState, Resume, Status, Stop
from handfast.deploy.orders.mission_editing import OrderError
from handfast.deploy.orders.operator import NO_MISSION, Known, Operator, refused
from tests.unit.deploy.orders.order_fleets import EPOCH, S, order, square

FLEET = square()
US = EPOCH // 1_000
MISSION, STOP, RESUME = (
    key_expressions.mission("square"),
    key_expressions.stop("square"),
    key_expressions.resume("square"),
)


def operator(*, begun: bool = True) -> Operator:
    made = Operator(FLEET, resolve(FLEET))
    if begun:
        made.begin(EPOCH - S, EPOCH, 60 * S)
    return made


def status(
    robot: int, mission: int = 0, orders: int = 0, state: str = "running", time_ns: int = EPOCH
) -> Status:
    return Status(robot, 1, time_ns, state, "", "", mission, orders, (), (), (), ())


def plant(robot: int, *, driving: bool = True, sequence: int = FIRST_ROUND) -> PlantState:
    return PlantState(robot, sequence, EPOCH, *[0.0] * 7, driving, True, True, "")


def everybody(mission: int, orders: int) -> Mapping[int, Status]:
    return {robot: status(robot, mission, orders) for robot in FLEET.ids}


PLANTS = {robot: plant(robot) for robot in FLEET.ids}


def up(robot: int, role: str) -> bool:
    return True


def test_the_first_mission_is_the_files_and_orders_build_on_it() -> None:
    made = operator()
    assert made.mission is not None
    assert made.mission.robots == ()
    assert made.mission.version == US - 1_000_000
    joins = made.give(order("join", robot=7, edges=(2, 3)), EPOCH + 5 * S)
    leaves = made.give(order("leave", robot=4), EPOCH + 6 * S)
    assert isinstance(joins, Mission)
    assert isinstance(leaves, Mission)
    assert [row[0] for row in leaves.robots] == [1, 2, 3, 7]
    assert made.mission == leaves
    assert made.plan is not None
    assert made.plan.members == (1, 2, 3, 7)
    assert joins.version < leaves.version


def test_versions_are_those_of_the_clock_and_greater_than_any_that_was_heard_of() -> None:
    made = operator()
    assert made.order_stop(EPOCH, "").version == US
    assert made.order_stop(EPOCH, "").version == US + 1
    made.hear(key_expressions.status("square", 2), status(2, orders=US + 50))
    assert made.order_resume(EPOCH, ()).version == US + 51
    beacon = Beacon(2, 1, EPOCH, True, *[0.0] * 5, US + 90, 0, US + 80, -1)
    made.hear(key_expressions.beacon("square", 2), beacon)
    assert made.order_stop(EPOCH, "").version == US + 81
    assert made.give(order("leave", robot=4), EPOCH).version == US + 91
    made.hear(STOP, Stop(US + 500, EPOCH, "of another operator"))
    assert made.order_resume(EPOCH, (3,)) == (US + 501, EPOCH, (3,))


def test_what_others_order_is_taken_when_it_is_newer() -> None:
    known, other = Known(FLEET, resolve(FLEET)), operator()
    first = other.mission
    assert first is not None
    second = other.give(order("leave", robot=4), EPOCH)
    assert isinstance(second, Mission)
    assert known.hear(MISSION, second)
    assert not known.hear(MISSION, second)
    assert not known.hear(MISSION, first)
    assert known.mission == second
    assert not known.hear(STOP, second._replace(version=US + 100)), "on another key"
    assert not known.hear(MISSION, second._replace(version=US + 100, digest="of another fleet file"))
    unknown = second._replace(version=US + 100, robots=((77, 0.0, 0.0),))
    assert not known.hear(MISSION, unknown), "it cannot be driven"
    assert known.hear(STOP, Stop(5, EPOCH, ""))
    assert not known.hear(STOP, Stop(5, EPOCH, "the same version"))
    assert known.hear(RESUME, Resume(4, EPOCH, ()))
    assert not known.hear(RESUME, Resume(3, EPOCH, ()))
    assert [type(each) for each in known.latest] == [Stop, Resume]
    assert (known.mission_version, known.order_version) == (second.version, 5)


def test_what_a_robot_tells_of_an_order_is_that_order_and_no_strangers_is() -> None:
    made = operator(begun=False)
    begun = operator()
    stop, resume = begun.order_stop(EPOCH, "x"), begun.order_resume(EPOCH, ())
    assert begun.mission is not None
    orders = (begun.mission, stop, resume)
    wrong = (
        key_expressions.relayed("square", 99),
        key_expressions.relayed("other", 1),
        key_expressions.hand("square", 1),
        key_expressions.ask("square"),
    )
    assert not any(made.hear(key, order) for key in wrong for order in orders)
    assert [made.hear(key_expressions.relayed("square", 2), order) for order in orders] == [True] * 3
    assert not any(made.hear(key_expressions.relayed("square", 3), order) for order in orders)
    assert (made.mission, made.latest) == (begun.mission, [stop, resume])
    assert not made.hear(key_expressions.relayed("square", 2), Heartbeat(EPOCH, "x"))


def test_an_order_that_cannot_be_changes_nothing() -> None:
    made = operator()
    before = made.mission
    with pytest.raises(OrderError) as caught:
        made.give(order("leave", robot=7), EPOCH)
    assert refused(order("leave", robot=7), caught.value) == (
        "The order at 0 s (leave) was not given: robot 7 has no place in the formation: "
        "members are 1, 2, 3 and 4."
    )
    assert made.mission is before
    with pytest.raises(OrderError, match="agent of robot 4 is heard: only the body"):
        made.give(order("remove", robots=(4,)), EPOCH, heard={1, 4})
    assert made.mission is before
    with pytest.raises(OrderError, match=NO_MISSION):
        operator(begun=False).give(order("leave", robot=4), EPOCH)


def test_stop_and_resume_are_given_like_other_orders() -> None:
    made = operator(begun=False)
    stop = made.order_stop(EPOCH, "a person")
    assert stop == Stop(US, EPOCH, "a person")
    assert made.give(order("resume", robots=(2, 3)), EPOCH) == Resume(US + 1, EPOCH, (2, 3))
    assert made.order_stop(EPOCH, "ü" * 300).reason.endswith("...")


def test_messages_go_out_on_their_keys() -> None:
    made = operator()
    key, payload = made.outgoing(made.order_stop(EPOCH, "x"))
    assert (key, decode(payload)) == (STOP, made.stop)
    assert made.outgoing(Ask(EPOCH, "me"))[0] == key_expressions.ask("square")
    assert made.mission is not None
    assert made.outgoing(made.mission)[0] == MISSION


def test_nothing_is_said_again_to_those_who_know() -> None:
    made = operator()
    assert made.wanted(everybody(made.mission_version, 0), PLANTS, up) == []
    made.order_stop(EPOCH, "")
    stopped = everybody(made.mission_version, made.order_version)
    assert made.wanted(stopped, PLANTS, up) == []
    ahead = everybody(made.mission_version + 1, made.order_version + 1)
    assert made.wanted(ahead, PLANTS, up) == []


def test_a_stop_is_said_before_the_mission_to_a_process_that_started_again() -> None:
    made = operator()
    stop = made.order_stop(EPOCH, "")
    resume = made.order_resume(EPOCH, (1,))
    version = made.mission_version
    agent_is_new = {**everybody(version, resume.version), 3: status(3, 0, resume.version)}
    assert made.wanted(agent_is_new, PLANTS, up) == [stop, resume, made.mission]
    knowing = everybody(version, resume.version)
    assert made.wanted(knowing, {**PLANTS, 3: plant(3, sequence=40)}, up) == [stop, resume, made.mission]
    silent = {robot: state for robot, state in PLANTS.items() if robot != 3}
    assert made.wanted(knowing, silent, up) == [stop, resume, made.mission]
    assert made.wanted(knowing, silent, lambda robot, role: (robot, role) != (3, "plant")) == []
    assert made.wanted(agent_is_new, PLANTS, lambda robot, role: (robot, role) != (3, "agent")) == []
    # One that counts from the epoch of a drive before this one.
    old = plant(3, sequence=FIRST_ROUND + 4321)
    assert made.wanted(knowing, {**PLANTS, 3: old}, up) == [stop, resume, made.mission]


def test_who_missed_a_stop_or_leave_is_told_again() -> None:
    made = operator()
    stop = made.order_stop(EPOCH, "")
    missed = {**everybody(made.mission_version, stop.version), 2: status(2, made.mission_version, 0)}
    assert made.wanted(missed, PLANTS, up) == [stop]
    resume = made.order_resume(EPOCH, ())
    driving = everybody(made.mission_version, resume.version)
    assert made.wanted(driving, {**PLANTS, 2: plant(2, driving=False)}, up) == [stop, resume]
    standing = {**driving, 2: status(2, made.mission_version, resume.version, "ready")}
    assert made.wanted(standing, {**PLANTS, 2: plant(2, driving=False)}, up) == []


def test_a_resume_is_of_the_time_at_which_it_was_given() -> None:
    """A stop that is given meanwhile is later, whichever of them robots hear first."""
    made = operator(begun=False)
    given_ns, now_ns = EPOCH, EPOCH + 5 * S
    meanwhile = (EPOCH + S) // 1_000
    made.hear(key_expressions.status("square", 2), status(2, 0, meanwhile))  # which was not heard here
    assert made.order_resume(now_ns, (), given_ns).version == given_ns // 1_000 < meanwhile
    # What is known to be lifted is.
    made.hear(key_expressions.stop("square"), Stop(meanwhile, EPOCH + S, "known"))
    assert made.order_resume(now_ns, (), given_ns).version == meanwhile + 1
    assert made.order_resume(now_ns, ()).version == now_ns // 1_000


def test_an_order_of_a_time_to_come_is_heard_as_robots_take_it() -> None:
    made, far = operator(begun=False), US + AHEAD_US_MAX + 1
    assert made.hear_at(EPOCH, RESUME, Resume(far, EPOCH, ())) is None
    assert made.resume is None
    assert made.hear_at(EPOCH, STOP, Stop(far, EPOCH, "ahead")) == Stop(US, EPOCH, "ahead") == made.stop
    assert made.hear_at(EPOCH, STOP, Stop(US - 1, EPOCH, "older")) is None
    assert made.hear_at(EPOCH, key_expressions.status("square", 1), status(1, orders=US + 5)) is None
    assert made.behind
