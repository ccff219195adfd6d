"""Which faults hold: live rules that come, go and run out, and what is said of them."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.fault_plan import AUTHORS_MAX, FaultPlan
from handfast.agent.messages.types import EVERY_AUTHOR, Faults

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0 }]
fleet = { name = "two" }
formation = { edges = [[1, 2]], offsets = [[0, 0], [1, 0]], safe_distance_m = 0.2 }
"""
NOW = 1000 * NS_PER_S
PERIOD = 20_000_000
CUT = '[[faults.rule]]\nname = "cut"\nlink = "1->2"\nloss = "100%"\n'


def fleet(faults: str = "", *overrides: str) -> Fleet:
    return parse_fleet(FLEET + faults, source="here", overrides=overrides)


def live(
    rules: str = CUT, version: int = 1, author: str = "ana", time_ns: int = NOW, lease_s: float = 2.0
) -> Faults:
    return Faults(version, time_ns, author, NOW, round(lease_s * NS_PER_S), rules)


def lost(plan: FaultPlan, time_ns: int) -> float:
    """Share of messages of the link from 1 to 2 that are lost at a time."""
    loss = plan.rules_of_link(1, 2, "hand").effects(time_ns).loss
    return 0.0 if loss is None else loss.rate


# --- the plan ---------------------------------------------------------------------------------


def test_live_rules_hold_from_their_origin_to_the_end_of_their_lease() -> None:
    plan = FaultPlan(fleet())
    assert plan.take(live(), NOW) is None
    assert [lost(plan, NOW + dt) for dt in (-1, 0, 2 * NS_PER_S - 1, 2 * NS_PER_S)] == [0, 1, 1, 0]


def test_an_old_renewal_that_comes_late_shortens_no_lease() -> None:
    plan = FaultPlan(fleet())
    plan.take(live(time_ns=NOW + NS_PER_S), NOW + NS_PER_S)
    assert plan.take(live(), NOW + NS_PER_S) == "duplicate"
    assert not plan.expire(NOW + 3 * NS_PER_S - 1)


def test_rules_that_are_to_stay_stay_until_they_are_cleared() -> None:
    plan = FaultPlan(fleet())
    plan.take(live(lease_s=0.0), NOW)
    assert not plan.expire(NOW + 10**6 * NS_PER_S)
    assert lost(plan, NOW + 10**6 * NS_PER_S) == 1
    assert plan.take(Faults(2, NOW, EVERY_AUTHOR, NOW, 0, ""), NOW) is None
    assert lost(plan, NOW) == 0
    assert plan.take(live(lease_s=0.0), NOW) == "out_of_order"  # what was cleared does not come back
    assert plan.take(live(version=3, lease_s=0.0), NOW) is None


def test_clearing_leaves_what_came_later() -> None:
    plan = FaultPlan(fleet())
    plan.take(live(version=5), NOW)
    assert plan.take(Faults(2, NOW, EVERY_AUTHOR, NOW, 0, ""), NOW) is None
    assert lost(plan, NOW) == 1


def test_a_new_version_replaces_the_old_one_and_never_the_other_way_round() -> None:
    plan = FaultPlan(fleet())
    plan.take(live(version=2), NOW)
    weaker = CUT.replace("100%", "20%")
    assert plan.take(live(weaker, version=3), NOW) is None
    assert lost(plan, NOW) == 0.2
    assert plan.take(live(version=2), NOW) == "out_of_order"
    assert plan.take(live(CUT, version=3), NOW) == "duplicate"  # the same number for other rules
    assert lost(plan, NOW) == 0.2


def test_newer_authors_win_and_live_rules_win_over_the_files() -> None:
    plan = FaultPlan(fleet('[[faults.rule]]\nlink = "1->2"\nloss = "5%"\n'))
    assert lost(plan, NOW) == 0.05
    plan.take(live(CUT.replace("100%", "20%"), version=1, author="ana"), NOW)
    assert lost(plan, NOW) == 0.2
    plan.take(live(CUT.replace("100%", "50%"), version=2, author="ben"), NOW)
    assert lost(plan, NOW) == 0.5


def test_of_two_authors_at_once_the_same_wins_everywhere() -> None:
    sets = [
        live(CUT.replace("100%", share), author=author) for share, author in (("20%", "ana"), ("50%", "ben"))
    ]
    for order in (sets, sets[::-1]):
        plan = FaultPlan(fleet())
        for message in order:
            plan.take(message, NOW)
        assert lost(plan, NOW) == 0.2


def test_authors_are_bounded() -> None:
    plan = FaultPlan(fleet())
    said = [plan.take(live(author=f"author {number}"), NOW) for number in range(AUTHORS_MAX + 1)]
    assert said == [None] * AUTHORS_MAX + ["authors"]


def test_file_times_count_from_the_epoch_and_live_times_from_their_origin() -> None:
    plan = FaultPlan(fleet(CUT + "at = 1\nfor = 1\n"))
    assert lost(plan, NOW) == 0
    plan.begin(NOW)
    assert [lost(plan, NOW + dt * NS_PER_S // 2) for dt in range(5)] == [0, 0, 1, 1, 0]
    plan.begin(NOW + NS_PER_S)
    assert [lost(plan, NOW + dt * NS_PER_S // 2) for dt in range(7)] == [0, 0, 0, 0, 1, 1, 0]


def test_sensors_clocks_and_ticks() -> None:
    plan = FaultPlan(
        fleet(
            "[[faults.rule]]\nrobot = 1\njump_m = 0.1\n"
            "[[faults.rule]]\njump_m = 0.2\nheading_bias_rad = 0.3\ntick_jitter = 0.005\n"
            '[[faults.rule]]\nrobot = 2\nclock_skew = "-100ms 20ppm"\n'
        )
    )
    one, two = plan.sensor(1, NOW), plan.sensor(2, NOW)
    assert one is not None
    assert (one.jump_m, one.heading_bias_rad) == (0.1, 0.3)
    assert two is not None
    assert (two.jump_m, two.position_bias_m) == (0.2, (0.0, 0.0))
    assert plan.tick_jitter(1, NOW) == (5_000_000, 1.0)  # all of them
    assert plan.clock(1) == (0, 0.0)
    assert plan.clock(2) == (-100_000_000, 20e-6)
    assert FaultPlan(fleet()).sensor(1, NOW) is None


def test_live_faults_are_rules_and_nothing_else() -> None:
    plan = FaultPlan(fleet())
    assert plan.take(live('[faults]\nloss = "5%"\n'), NOW) == "scenario"
    assert plan.take(live("[faults]\nseed = 5\n"), NOW) == "scenario"
    for done_elsewhere in ('kill = "agent"\nat = 1\n', 'clock_skew = "1s"\n'):
        assert plan.take(live(f"[[faults.rule]]\nrobot = 1\n{done_elsewhere}"), NOW) == "scenario"
