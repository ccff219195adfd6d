"""Places that are dragged are a reshaping; what would come of it is what `check` finds."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from typing import Any

import pytest

from handfast.agent.formation.geometry import resolved
from handfast.agent.formation.mission_plan import Plan, plan_of
from handfast.deploy.check.check import check
from handfast.deploy.check.finding import Finding
from handfast.deploy.orders.mission_editing import ordered
from handfast.deploy.view import moves
from handfast.deploy.view.moves import SAID_MAX, judged, order_to_move
from handfast.deploy.view.orders import RefusedError
from tests.unit.deploy.orders.order_fleets import EPOCH, S, first_plan, square

FLEET = resolved(square())
PLAN = first_plan(FLEET)
NOW_NS = EPOCH + 10 * S


def moved(by: dict[str, Any], plan: Plan = PLAN) -> dict[int, tuple[float, float]]:
    """Where members have their places after such a move."""
    mission = ordered(order_to_move({"by": by}, plan, FLEET), plan, FLEET, NOW_NS, 9)
    return {place.robot: (place.x, place.y) for place in mission.robots}


def test_edges_stay_and_are_as_long_as_their_places_are_apart() -> None:
    mission = ordered(order_to_move({"by": {"2": [1, 0]}}, PLAN, FLEET), PLAN, FLEET, NOW_NS, 9)
    plan = plan_of(mission, FLEET, None)
    assert plan.edges.keys() == PLAN.edges.keys()
    assert plan.edges[1, 2] == pytest.approx(2.0)
    assert plan.edges[3, 4] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "by",
    [
        None,
        [],
        {},
        "3",
        {"7": [0, 0]},
        {"99": [0, 0]},
        {"-1": [0, 0]},
        {"3.0": [0, 0]},
        {"²": [0, 0]},
        {"٣": [0, 0]},
        {" 3": [0, 0]},
        {"9" * 5_000: [0, 0]},
        {"": [0, 0]},
        {3: [0, 0]},
        {"3": None},
        {"3": 1.0},
        {"3": []},
        {"3": [1]},
        {"3": [1, 2, 3]},
        {"3": {"x": 1, "y": 2}},
        {"3": "12"},
        {"3": [nan, 0]},
        {"3": [0, inf]},
        {"3": [-inf, 0]},
        {"3": [10**400, 0]},
        {"3": [1e300, 0]},
        {"3": ["1", "0"]},
        {"3": [True, False]},
        {"3": [None, None]},
        {"3": [[1], [0]]},
        {"3": [0.1, 0.1], "7": [0, 0]},
    ],
)
def test_what_is_no_move_is_refused(by: Any) -> None:
    with pytest.raises(RefusedError) as caught:
        order_to_move({"by": by}, PLAN, FLEET)
    assert str(caught.value).startswith(("nothing is moved", "by."))


# ---------------------------------------------------------------------- what would come of it


def test_what_would_come_of_a_move_is_what_check_finds_besides() -> None:
    """Robot 3 in one line with 1 and 2: the formation can be bent there."""
    order_of_it = order_to_move({"by": {"3": [1.0, -1.0]}}, PLAN, FLEET)
    text, fine = judged(order_of_it, PLAN, FLEET, NOW_NS)
    offsets = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0))
    edges = tuple(PLAN.edges)
    apart = {(1, 2): 1.0, (2, 3): 1.0, (3, 4): 5**0.5, (1, 4): 1.0, (1, 3): 2.0}
    formation = replace(
        FLEET.formation, offsets=offsets, edges=edges, distance_m=tuple(apart[edge] for edge in edges)
    )
    known = {each.message for each in check(FLEET)}
    found = [
        each
        for each in check(replace(FLEET, formation=formation))
        if each.message not in known and each.level in ("error", "warning")
    ]
    assert found
    for each in found[:SAID_MAX]:
        assert f"{each.level}: {each.message}" in text
    assert fine == all(each.level != "error" for each in found)
    assert text.endswith(" s")


def test_only_an_error_keeps_it_from_being_ordered(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = order_to_move({"by": {"3": [0.1, 0.1]}}, PLAN, FLEET)
    for levels, is_fine in ((["warning"] * 5, True), (["warning", "error"], False), (["info"], True)):
        found = [Finding(level, "there", f"number {number}") for number, level in enumerate(levels)]  # type: ignore[arg-type]
        checked = iter([[], found])
        monkeypatch.setattr(moves, "check", lambda _, checked=checked: next(checked))
        text, fine = judged(moved, PLAN, FLEET, NOW_NS)
        assert fine == is_fine
        assert ("; and 2 more; " in text) == (len(levels) == 5)
        assert (f"{levels[0]}: number 0" in text) == (levels != ["info"])
