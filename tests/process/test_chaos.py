"""Kills, starts, pauses and a partition of real processes, drawn from a seed: every oracle holds."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from handfast.deploy.recording.mcap_reader import read_run
from tests.process.harness import BUSY, Command, no_trouble_in_logs

pytestmark = [pytest.mark.long, pytest.mark.alone]
NETWORK = ("--set", "network.base_port=21120")
ROUTED = ("--set", 'network.routers=["10.0.0.1:7447", "10.0.0.2:7447"]')
ROBOTS = (1, 2, 3, 4, 5, 6)
DURATION_S = 40
TROUBLE_S = 17.0
"""From then on nothing happens: the oracle of recovery gives robots 20 s to be in formation again."""
EVENTS = 7


def scenario(seed: int) -> str:
    """Fault rules for six robots: each of `EVENTS` at its own time, and a partition."""
    draw = random.Random(seed)
    rules = []
    for number in range(EVENTS):
        at = round(1.0 + (TROUBLE_S - 4.0) * (number + draw.random()) / EVENTS, 2)
        role = draw.choice(("agent", "agent", "plant"))
        what = draw.choice(("kill", "pause", "restart"))
        lasts = "" if what == "restart" else f"for = {draw.uniform(0.3, 2.5):.2f}\n"
        rules.append(f'robot = {draw.choice(ROBOTS)}\n{what} = "{role}"\nat = {at}\n{lasts}')
    first = sorted(draw.sample(ROBOTS, draw.randint(1, 5)))
    groups = first, [robot for robot in ROBOTS if robot not in first]
    parts = " | ".join(",".join(map(str, group)) for group in groups)
    at, lasts = draw.uniform(2.0, 9.0), draw.uniform(1.0, 6.0)
    rules.append(f'partition = "{parts}"\nat = {at:.2f}\nfor = {lasts:.2f}\n')
    return "\n".join(f'[[faults.rule]]\nname = "chaos {k}"\n{rule}' for k, rule in enumerate(rules))


@pytest.mark.parametrize(("seed", "network"), [(1, ()), (2, ROUTED)], ids=["mesh", "routed"])
def test_every_oracle_holds(tmp_path: Path, seed: int, network: tuple[str, ...]) -> None:
    print(f"seed {seed}")
    rules = tmp_path / "rules.toml"
    rules.write_text(scenario(seed))
    print(rules.read_text())
    arguments = ("run", "delta", "--duration", str(DURATION_S), "--faults", str(rules), "--out", "out")
    with Command(tmp_path, *arguments, "--no-report", *NETWORK, *network, *BUSY) as run:
        run.wait_for_line("all 12 processes alive", 60.0)
        assert len(run.children()) == 12
        assert ("through 2 routers" in run.err) == bool(network)
        status = run.wait(DURATION_S + 60.0)
        assert status == 0, run.told()
    folder = tmp_path / "out"
    no_trouble_in_logs(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    oracles = metrics["oracles"]
    assert not any(found["violations"] for found in oracles.values()), oracles
    assert {"separation", "limits", "recovery", "one_mission"} <= {
        name for name, found in oracles.items() if found["checked"]
    }, oracles
    done = read_run(folder).events
    assert len(done) >= EVENTS, done
