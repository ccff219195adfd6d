"""Random scenarios: what is drawn, how they end, how one that fails is made smaller, and the command."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.control import constraint_assembly
from handfast.agent.control.boundaries import obstacles_of
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.formation.geometry import start_hands
from handfast.deploy.console.arguments import fleet_path, fleet_text
from handfast.deploy.simulate.worker_pool import Abandoned, GoOn
from handfast.deploy.verdict.violations import Violation
from tests.chaos import __main__ as command
from tests.chaos import shrink as shrinking
from tests.chaos.dice import Dice, Tables
from tests.chaos.layout import APART_FACTOR
from tests.chaos.presets import PRESETS
from tests.chaos.report import Driven, Tally, lines, parts
from tests.chaos.run import ELSEWHERE, IN_FORMATION, SOON, Outcome, drive
from tests.chaos.scenario import draw, preset_of, seeds_of
from tests.chaos.shrink import shrink, without_robot
from tests.chaos.text import scenario_text

ROOT = Path(__file__).parents[2]
FAILED = Outcome((Violation("separation", 9.0, "Robots 1 and 2 came too close."),), ended=IN_FORMATION)
WALL = "\n[[obstacle]]\npoints_m = [[-6.0, -0.2], [6.0, -0.2], [6.0, 0.2], [-6.0, 0.2]]\n"


@pytest.fixture(scope="module")
def drawn() -> dict[int, Tables]:
    """Tables by seed."""
    return {seed: draw(seed) for seed in range(60)}


# --- drawing ----------------------------------------------------------------------------------------


def test_dice_give_the_same_numbers_on_every_machine() -> None:
    assert [Dice("a", 1).whole(0, 10**6), Dice("b").whole(0, 10**6)] == [315_958, 762_105]


def test_dice_stay_within_bounds_and_follow_weights() -> None:
    dice = Dice("bounds")
    assert {dice.whole(2, 4) for _ in range(200)} == {2, 3, 4}
    between = [dice.between(-1.0, 1.0, 1) for _ in range(500)]
    assert (min(between), max(between)) == (-1.0, 1.0)
    weighted = [dice.weighted((("often", 3.0), ("rarely", 1.0), ("never", 0.0))) for _ in range(4000)]
    assert weighted.count("often") == pytest.approx(3000, abs=120)
    assert "never" not in weighted
    some = [dice.some([1, 2, 3, 4], count) for count in range(6)]
    assert [len(each) for each in some] == [0, 1, 2, 3, 4, 4]
    assert all(each == sorted(set(each)) for each in some)


def test_a_seed_draws_the_same_text_in_another_process(drawn: dict[int, Tables]) -> None:
    script = (
        "from tests.chaos.text import scenario_text; from tests.chaos.scenario import draw\n"
        "print(''.join(scenario_text(draw(seed)) for seed in range(4)), end='')"
    )
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(ROOT)}
    again = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, check=True)
    assert again.stdout.decode() == "".join(scenario_text(drawn[seed]) for seed in range(4))


def test_starts_and_places_are_well_apart(drawn: dict[int, Tables]) -> None:
    for seed, tables in drawn.items():
        fleet = parse_fleet(scenario_text(tables), source=f"seed {seed}")
        safe_m, hands = fleet.formation.safe_distance_m, start_hands(fleet).tolist()
        assert all(dist(a, b) > 1.49 * safe_m for a, b in combinations(hands, 2)), seed
        assert fleet.formation.offsets is not None
        least_m = APART_FACTOR * safe_m - 0.01
        assert all(dist(a, b) > least_m for a, b in combinations(fleet.formation.offsets, 2)), seed
        for obstacle in obstacles_of(fleet):
            nearest = [each.distance for x, y in hands for each in obstacle.near(x, y, 100.0)]
            assert min(nearest) > 0.5 * safe_m + 0.3, seed


def test_presets_are_drawn_as_often_as_their_weights_say() -> None:
    counts = Counter(preset_of(seed) for seed in range(2000))
    total = sum(preset.weight for preset in PRESETS.values())
    for name, preset in PRESETS.items():
        assert counts[name] / 2000 == pytest.approx(preset.weight / total, abs=0.03), name
    found = seeds_of("fast", 10, 5)
    assert found == [seed for seed in range(10, found[-1] + 1) if preset_of(seed) == "fast"]


def test_every_feature_is_drawn_in_some_scenario(drawn: dict[int, Tables]) -> None:
    found: Counter[str] = Counter()
    for tables in drawn.values():
        found += parts(tables)
    orders = {"join", "leave", "replace", "remove", "reshape", "stop", "resume"}
    faults = {
        "clock_skew", "corrupt", "delay", "duplicate", "loss", "partition", "range", "reorder",
        "tick_jitter", "kill agent", "kill agent for good", "kill both for good",
        "kill plant", "pause agent", "restart agent",
    }  # fmt: skip
    wanted = {"robots in reserve", "obstacles", "geofences", "dead-man's switches"}
    wanted |= {f"order: {order}" for order in orders} | {f"fault: {fault}" for fault in faults}
    assert wanted - set(found) == set()
    assert {tables["trajectory"]["kind"] for tables in drawn.values()} == {
        "hold", "line", "circle", "waypoints",
    }  # fmt: skip
    rovers = [tables for tables in drawn.values() if "mavlink" in tables["robot_defaults"]]
    assert rovers


# --- driving ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("duration_s", "more", "ended"),
    [(3, "", SOON), (20, "", IN_FORMATION), (20, WALL, SOON), (21, WALL, ELSEWHERE)],
)
def test_a_scenario_ends_in_formation_or_elsewhere(duration_s: int, more: str, ended: str) -> None:
    text = fleet_text(fleet_path("pair")).replace("duration_s = 20", f"duration_s = {duration_s}") + more
    assert drive(text).ended == ended


def test_a_scenario_driven_again_has_the_same_outcome() -> None:
    text = (ROOT / "tests/chaos/kept/drawn/53.toml").read_text(encoding="utf-8")
    first, again = drive(text), drive(text)
    assert first.driven_s > 20.0
    assert (first.violations, first.transitions, first.limits) == (
        again.violations, again.transitions, again.limits,
    )  # fmt: skip


# --- shrinking --------------------------------------------------------------------------------------


class Bug:
    """A program in which `separation` fails if some parts come together; counts drives."""

    def __init__(self, *needed: str) -> None:
        self._needed = needed
        self.runs = 0

    def __call__(self, text: str, go_on: GoOn) -> Outcome:
        if not go_on():
            raise Abandoned
        self.runs += 1
        fails = parse_fleet(text, source="here").fleet.duration_s >= 9.0
        return FAILED if fails and all(part in text for part in self._needed) else Outcome()


@pytest.fixture(scope="module")
def large(drawn: dict[int, Tables]) -> Tables:
    """A scenario with many parts, a stop among them."""
    stopped = [tables for tables in drawn.values() if parts(tables)["order: stop"]]
    return max(stopped, key=lambda tables: sum(parts(tables).values()))


def test_shrinking_leaves_out_what_the_violation_does_not_need(
    large: Tables, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = large["robot"][2]["id"]
    monkeypatch.setattr(shrinking, "drive", Bug(f"id = {robot},", 'kind = "stop"'))
    small, outcome = shrink(large, FAILED, lambda: True)
    assert outcome == FAILED
    assert [row["id"] for row in small["robot"]] == [robot]
    assert [order["kind"] for order in small["order"]] == ["stop"]
    assert not {"faults", "obstacle", "geofence", "supervision", "control"} & set(small)
    assert small["trajectory"] == {"kind": "hold"}
    assert small["fleet"]["duration_s"] == 9.5


def test_shrinking_drives_no_more_than_allowed(large: Tables, monkeypatch: pytest.MonkeyPatch) -> None:
    bug = Bug()
    monkeypatch.setattr(shrinking, "drive", bug)
    shrink(large, FAILED, lambda: True, runs_max=7)
    assert bug.runs == 7
    with pytest.raises(Abandoned):
        shrink(large, FAILED, lambda: False)


def test_shrinking_does_not_follow_another_fault(large: Tables, monkeypatch: pytest.MonkeyPatch) -> None:
    other = Outcome((Violation("clearance", 1.0, "into a wall"),))
    monkeypatch.setattr(shrinking, "drive", lambda text, go_on: other)
    assert shrink(large, FAILED, lambda: True, runs_max=20) == (large, FAILED)


@pytest.mark.parametrize("seed", range(12))
def test_a_fleet_without_one_of_its_robots_is_valid(seed: int, drawn: dict[int, Tables]) -> None:
    tables = drawn[seed]
    members = [row["id"] for row in tables["robot"] if not row.get("reserve")]
    for robot in [row["id"] for row in tables["robot"] if members != [row["id"]]]:
        fleet = parse_fleet(scenario_text(without_robot(tables, robot)), source=f"seed {seed}")
        assert set(fleet.ids) == {row["id"] for row in tables["robot"]} - {robot}


@pytest.mark.slow
@pytest.mark.patches
def test_a_fault_of_the_program_is_found_and_made_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constraint_assembly.ConstraintAssembly, "_keep_away", lambda *args, **options: None)
    (seed,) = seeds_of("crowded", 0, 1)
    tables = draw(seed)
    tables["fleet"]["duration_s"] = 6.0
    outcome = drive(scenario_text(tables))
    assert "separation" in outcome.oracles
    small, again = shrink(tables, outcome, lambda: True, runs_max=60)
    assert outcome.violations[0].oracle in again.oracles
    assert sum(parts(small).values()) <= 4 < sum(parts(tables).values())
    monkeypatch.undo()
    assert drive(scenario_text(small)).violations == ()


# --- the command ------------------------------------------------------------------------------------


def test_the_command_writes_scenarios_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--scenarios", "2", "--seed", "7", "--out", str(tmp_path), "--write"]) == 0
    for seed in (7, 8):
        path = tmp_path / f"chaos-{seed}.toml"
        assert str(path) in capsys.readouterr().out or seed == 8
        assert load_fleet(path) == parse_fleet(scenario_text(draw(seed)), source=str(path))


def test_the_command_keeps_a_scenario_that_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def virtual(seeds: list[int], jobs: int, **_: Any) -> list[Driven]:
        return [Driven(seed, draw(seed), FAILED if seed == 7 else Outcome()) for seed in seeds]

    monkeypatch.setattr(command, "virtual", virtual)
    assert command.main(["--scenarios", "3", "--seed", "6", "--out", str(tmp_path)]) == 1
    path, told = tmp_path / "chaos-7.toml", capsys.readouterr().out
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert f"seed 7: separation: {FAILED.violations[0].message} -> {path}\n" in told
    assert told.endswith("3 scenarios, 1 violations, 0 h 0 min of driving\n")
    assert f"#   separation: {FAILED.violations[0].message}" in path.read_text(encoding="utf-8")


def test_the_report_counts_failures_by_preset_and_names_transitions_never_taken() -> None:
    tally = Tally()
    for seed in seeds_of("dead", 0, 2):
        tally.add(Driven(seed, draw(seed), FAILED if seed % 2 else Outcome(ended=IN_FORMATION)))
    said = list(lines(tally))
    row = next(line for line in said if line.startswith("dead"))
    assert row.split()[1:4:2] == ["2", "2"]
    assert any(line.startswith("never taken: ") for line in said)
