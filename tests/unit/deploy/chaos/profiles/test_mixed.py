"""The mixed profile: everything, and quiet at the end."""

from __future__ import annotations

from agent.fleet.loading import parse_fleet
from deploy.chaos.profiles.mixed import QUIET_S, draw_mixed
from deploy.chaos.run import scenario_text


def test_the_end_is_quiet() -> None:
    for seed in range(40):
        fleet = parse_fleet(scenario_text(draw_mixed(seed)), source=f"seed {seed}")
        quiet_s = fleet.fleet.duration_s - QUIET_S + 1e-6
        assert all(order.at < quiet_s - 1.0 or order.kind == "resume" for order in fleet.orders), seed
        for rule in fleet.faults.rules:
            lasting = rule.at is None and rule.duration is None
            for_good = rule.kill is not None and rule.duration is None
            ends = [end for _, end in rule.windows(fleet.fleet.duration_s)]
            assert lasting or for_good or rule.restart is not None or max(ends) <= quiet_s, (seed, rule)
