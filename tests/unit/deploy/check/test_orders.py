"""What `handfast check` says of orders that cannot be carried out, in the turn in which they are given."""

from __future__ import annotations

import pytest

from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from tests.unit.deploy.orders.order_fleets import SQUARE, square

JOIN = '[[order]]\nat = {at}\nkind = "join"\nrobot = 7\nedges = [3, 4]\noffset_m = [0.5, 1.9]\n'
LEAVE = '[[order]]\nat = {at}\nkind = "leave"\nrobot = {robot}\n'


def found(*orders: str) -> list[Finding]:
    """What is said of the orders of the square."""
    findings = check(square("fleet.duration_s=60", text=SQUARE + "".join(orders)))
    return [finding for finding in findings if finding.place.startswith("order")]


def test_an_order_depends_on_those_that_are_given_before_it() -> None:
    (finding,) = found(JOIN.format(at=5), JOIN.format(at=6))
    assert finding == Finding(
        "error", "order[2]", "at 6 s, join: robot 7 has a place in the formation already"
    )
    assert found(JOIN.format(at=20), LEAVE.format(at=10, robot=7), JOIN.format(at=5)) == []


@pytest.mark.parametrize(
    ("at", "over", "says"),
    [
        (60, "", "60 s is not before the run's end at 60 s: it is never given"),
        (58, "over_s = 5\n", "what is ordered at 58 s is done at 64.02 s, after the run's end at 60 s"),
    ],
)
def test_orders_that_come_too_late_are_warned_of(at: float, over: str, says: str) -> None:
    (finding,) = found(LEAVE.format(at=at, robot=4) + over)
    assert (finding.level, finding.place) == ("warning", "order[1].at")
    assert says in finding.message


def test_a_graph_that_falls_apart_is_warned_of_once() -> None:
    cut = '[[order]]\nat = 5\nkind = "reshape"\nformation.edges = [[1, 2], [3, 4]]\n'
    (finding,) = found(cut, LEAVE.format(at=10, robot=4))
    assert (finding.level, finding.place) == ("warning", "order[1]")
    assert "the graph is in 2 parts, {1, 2}, {3, 4}" in finding.message


QUICK = '[[order]]\nat = {at}\nkind = "reshape"\nscale = {scale}\nover_s = {over}\n'


def test_a_change_that_robots_cannot_follow_is_said_with_the_time_that_is_enough() -> None:
    assert not found(QUICK.format(at=10, scale=2.0, over=5))
    (finding,) = found(QUICK.format(at=10, scale=4.0, over=0.5))
    assert (finding.level, finding.place) == ("warning", "order[1].over_s")
    assert "0.5 s are so few that places move at" in finding.message
    enough = float(finding.message.rpartition("; ")[2].split()[0])
    assert not found(QUICK.format(at=10, scale=4.0, over=1.1 * enough))


def test_what_is_left_of_the_change_before_counts() -> None:
    far = QUICK.format(at=10, scale=8.0, over=20)
    assert not found(far, QUICK.format(at=40, scale=1.05, over=2))
    (finding,) = found(far, QUICK.format(at=12, scale=1.05, over=2))
    assert (finding.level, finding.place) == ("warning", "order[2].over_s")


def test_a_turn_that_is_too_sharp_is_said_though_it_is_no_faster() -> None:
    turn = '[[order]]\nat = {at}\nkind = "reshape"\nover_s = {over}\n[order.trajectory]\nkind = "line"\n'
    turn += "velocity_mps = [-0.3, -0.1]\n"
    assert not found(turn.format(at=10, over=3))
    (finding,) = found(turn.format(at=10, over=0.1))
    assert (finding.level, finding.place) == ("warning", "order[1].over_s")
    assert "m/s2 (control.max_acceleration)" in finding.message
