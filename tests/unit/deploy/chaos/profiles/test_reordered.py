"""The reordered profile: all change places while some do not hear others."""

from __future__ import annotations

import tomli_w

from agent.fleet.loading import parse_fleet
from agent.formation.geometry import resolve
from deploy.chaos.draw import seeds_of
from deploy.chaos.profiles.reordered import AFTER_S, CUT_S, ORDER_S, draw_reordered
from deploy.check.check import check


def test_places_change_when_some_do_not_hear_others() -> None:
    ways, long_rows = set(), 0
    for seed in seeds_of("reordered", 0, 40):
        fleet = parse_fleet(tomli_w.dumps(draw_reordered(seed)), source="drawn")
        resolve(fleet)
        assert not [each for each in check(fleet) if each.level == "error"]
        (rule,) = fleet.faults.rules
        assert CUT_S[0] <= (rule.at or 0.0) <= CUT_S[1]
        ways.add("both" if rule.partition else "one way")
        for order in fleet.orders:
            assert ORDER_S[0] - 0.01 <= order.at - (rule.at or 0.0) <= ORDER_S[1] + 0.01 or order.at == 0.0
        assert abs(fleet.fleet.duration_s - fleet.orders[-1].at - AFTER_S) < 0.1
        long_rows += len(fleet.formation.edges) == len(fleet.robots) - 1
    assert ways == {"both", "one way"}
    assert long_rows > 20
