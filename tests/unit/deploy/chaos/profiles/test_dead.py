"""The profiles of the dead: they stay, others pass where they stand, and some start again."""

from __future__ import annotations

from collections import Counter
from typing import Any

from deploy.chaos.profiles.dead import AFTER_S, FORGOTTEN_S, REMOVED_S, draw_dead, draw_restarted

SEEDS = range(60)


def deaths(tables: dict[str, Any]) -> dict[int, float]:
    rules = tables["faults"]["rule"]
    return {rule["robot"]: rule["at"] for rule in rules if "kill" in rule and "for" not in rule}


def test_two_at_least_live_on_and_the_drive_goes_on_after_the_last() -> None:
    long = 0
    for seed in SEEDS:
        tables = draw_dead(seed)
        dead = deaths(tables)
        members = [row["id"] for row in tables["robot"] if not row.get("reserve")]
        assert 1 <= len(dead) <= len(members) - 2
        left_s = tables["fleet"]["duration_s"] - max(dead.values())
        assert left_s > AFTER_S - 0.1
        long += left_s > FORGOTTEN_S
    assert 15 < long < 45


def test_the_dead_are_replaced_sent_away_and_left() -> None:
    what: Counter[str] = Counter()
    for seed in SEEDS:
        tables = draw_dead(seed)
        dead = deaths(tables)
        orders = {order["robot"]: order for order in tables.get("order", ()) if order["kind"] != "remove"}
        for robot, at in dead.items():
            order = orders.get(robot)
            before = order is not None and order["at"] < at
            what["left before" if before else order["kind"] if order else "stays"] += 1
    assert {"replace", "leave", "left before", "stays"} == set(what)


def test_some_bodies_are_carried_off_when_nobody_hears_them_any_more() -> None:
    carried = 0
    for seed in SEEDS:
        tables = draw_dead(seed)
        dead = deaths(tables)
        for order in tables.get("order", ()):
            if order["kind"] == "remove":
                (robot,) = order["robots"]
                assert dead[robot] + REMOVED_S[0] <= order["at"] < tables["fleet"]["duration_s"] - 10.0
                carried += 1
    assert 5 < carried < 40


def test_who_starts_again_does_so_when_others_have_been_dead_for_long() -> None:
    for seed in SEEDS:
        tables = draw_restarted(seed)
        dead = deaths(tables)
        again = [rule for rule in tables["faults"]["rule"] if rule["robot"] not in dead]
        assert again
        for rule in again:
            back_s = rule["at"] + rule.get("for", 0.0)
            assert back_s >= max(dead.values()) + FORGOTTEN_S
            assert rule["at"] > 0.0


def test_some_stand_in_rows_and_drive_along_them() -> None:
    """As people lay fleets out: what comes back comes to the same line, to the bit."""
    straight = 0
    for seed in SEEDS:
        tables = draw_dead(seed)
        course = tables["trajectory"].get("waypoints_m", ())
        if course and all(y == 0.0 for _, y in course):
            straight += 1
            rows = Counter(y for _, y in tables["formation"]["offsets"])
            assert max(rows.values()) >= 3
            assert len(rows) <= 2
    assert 10 < straight < 40
