"""The profile of rovers: what is lost of them while they come together, and what comes after."""

from __future__ import annotations

from collections import Counter

import pytest

from deploy.chaos.dice import Tables
from deploy.chaos.profiles.rovers import (
    APART_M,
    DOWN_S,
    MISSED_QUIET_S,
    ORDERED_S,
    QUIET_S,
    SAFE_M,
    draw_rovers,
)

SEEDS = range(80)


def test_something_is_lost_of_each_kind() -> None:
    what: Counter[str] = Counter()
    for seed in SEEDS:
        for rule in draw_rovers(seed)["faults"]["rule"]:
            if "partition" in rule:
                what["partition"] += 1
            elif "kill" in rule:
                what[f"{'kill' if 'for' in rule else 'for good'} {rule['kill']}"] += 1
            else:
                what["pause"] += 1
            assert rule.get("for", DOWN_S[0]) >= DOWN_S[0]
    assert {"partition", "kill plant", "kill both", "kill agent", "for good both", "pause"} <= set(what)


def test_of_two_to_whom_something_happens_neither_is_the_other() -> None:
    pairs = [rules for seed in SEEDS if len(rules := draw_rovers(seed)["faults"]["rule"]) == 2]
    assert any(first["name"] == "rolls" for first, _ in pairs)
    assert any(first["name"] != "rolls" for first, _ in pairs)
    for first, second in pairs:
        robots = {
            each.get("robot", each.get("partition", "").removeprefix("alone ")) for each in (first, second)
        }
        assert len({int(robot) for robot in robots}) == 2


@pytest.mark.slow
def test_some_roll_at_one_that_hears_them_from_far_enough_away() -> None:
    alone = [rules for seed in SEEDS if len(rules := draw_rovers(seed)["faults"]["rule"]) == 1]
    aimed = [rule for (rule,) in alone if rule["name"] == "rolls" and "kill" in rule]
    assert len(aimed) > 4
    assert len(aimed) < len(alone)
    assert any(tables["order"][1]["at"] < tables["faults"]["rule"][0]["at"] for tables in ordered_twice())


def ordered_twice() -> list[Tables]:
    return [tables for seed in SEEDS if len((tables := draw_rovers(seed)).get("order", ())) > 1]


def test_an_operator_tells_them_to_go_on_once_all_are_back() -> None:
    ordered = stopped = 0
    for seed in SEEDS:
        tables = draw_rovers(seed)
        back_s = max(rule["at"] + rule.get("for", 0.0) for rule in tables["faults"]["rule"])
        left_s = tables["fleet"]["duration_s"] - back_s
        dies_s = min(rule["at"] for rule in tables["faults"]["rule"])
        *stops, resume = [each for each in tables.get("order", ()) if each["at"] > dies_s] or [None]
        for stop in stops:
            assert stop["kind"] == "stop"
            assert stop["at"] < resume["at"]
            stopped += 1
        for order in [resume] if resume else ():
            assert order["kind"] == "resume"
            assert ORDERED_S[0] - 0.01 <= order["at"] - back_s <= ORDERED_S[1] + 0.01
            left_s = tables["fleet"]["duration_s"] - order["at"]
            ordered += 1
        missed = any(rule["name"].endswith("misses it") for rule in tables["faults"]["rule"])
        assert abs(left_s - (MISSED_QUIET_S if missed else QUIET_S)) < 0.06
    assert 30 < ordered < 65
    assert stopped > 3


def test_there_is_room_at_the_start() -> None:
    assert APART_M > 1.5 * SAFE_M
    assert all(row["plant"] == "mavlink" for row in (draw_rovers(seed)["robot_defaults"] for seed in SEEDS))
