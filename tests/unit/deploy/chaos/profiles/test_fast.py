"""The fast profile: near the greatest speed, with links that are bad all the time and nothing else."""

from __future__ import annotations

from agent.fleet.fault_rules import Rule
from agent.fleet.loading import parse_fleet
from agent.formation.geometry import start_hands
from agent.formation.trajectory import maximum_speed
from deploy.chaos.profiles.fast import DELAY_MAX_MS, DURATION_S, ERROR_M, LOSS_MAX, SHARES, draw_fast
from deploy.chaos.run import scenario_text
from deploy.verdict.oracles_drive import formed_by_s, is_mild


def test_what_is_drawn_is_what_the_oracle_judges() -> None:
    shares, delays, restarted = [], [], []
    for seed in range(60):
        fleet = parse_fleet(scenario_text(draw_fast(seed)), source=f"seed {seed}")
        assert all(rule.restart or rule.kill or rule.topic == "wrench" for rule in fleet.faults.rules)
        restarted.append(bool(fleet.faults.rules))
        assert not fleet.orders
        speed = maximum_speed(fleet.trajectory)
        shares.append(speed / fleet.control.max_speed_mps)
        assert formed_by_s(2.0**0.5 * ERROR_M, speed, fleet) < DURATION_S
        delay, loss = fleet.faults.delay, fleet.faults.loss
        if delay is not None:
            delays.append(1e3 * delay.start.mean)
        assert loss is None or loss.start.rate <= LOSS_MAX / 100.0
        assert len(start_hands(fleet)) == len(fleet.members)
    assert SHARES[0] - 0.01 <= min(shares) < 0.5 < 0.8 < max(shares) <= SHARES[1] + 0.01
    assert 5 < sum(restarted) < 25
    assert min(delays) < 150.0 < 850.0 < max(delays) <= DELAY_MAX_MS


def test_links_are_mild_enough_to_be_judged() -> None:
    for seed in range(60):
        fleet = parse_fleet(scenario_text(draw_fast(seed)), source=f"seed {seed}")
        assert is_mild(Rule(delay=fleet.faults.delay, loss=fleet.faults.loss))
