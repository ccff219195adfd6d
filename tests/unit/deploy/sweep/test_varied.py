"""What ``--over`` may be: values, a range of numbers of the field's own unit, and what is neither."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.fleet.model import FleetError
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.sweep.plan import Plan, Question, make_plan
from handfast.deploy.sweep.varied import Range, SweepError, parse_over


def plan_of(over: str, repeat: int = 40, law: str | None = None, *overrides: str) -> Plan:
    drawn = parse_over(over)
    assert isinstance(drawn, Range)
    text = (FLEETS / "pair.toml").read_text()
    return make_plan(Question("pair", text, law, overrides, (), repeat, None, (drawn,)))


@pytest.mark.parametrize(
    ("text", "ends", "unit"),
    [
        ("faults.delay=0..1.4s", (0.0, 1.4), "s"),
        ("faults.delay=10..50ms", (0.01, 0.05), "s"),
        ("faults.delay=0..1min", (0.0, 60.0), "s"),
        ("faults.delay=0..0.5", (0.0, 0.5), ""),
        ("faults.loss=10..50%", (0.1, 0.5), "ratio"),
        ("faults.loss=0..0.5", (0.0, 0.5), ""),
        ("faults.rate=10kbit..1mbit", (1e4, 1e6), "bit/s"),
        ("control.kp=0.5..2", (0.5, 2.0), "1/s2"),
        ("fleet.duration_s=1..2min", (60.0, 120.0), "s"),
        ("robot.1.mass_kg=500g..10kg", (0.5, 10.0), "kg"),
    ],
)
def test_a_range_is_of_the_fields_own_unit(text: str, ends: tuple[float, float], unit: str) -> None:
    drawn = parse_over(text)
    assert isinstance(drawn, Range)
    assert (drawn.low, drawn.high, drawn.unit, drawn.whole) == (*map(pytest.approx, ends), unit, False)


@pytest.mark.parametrize(
    ("over", "says"),
    [
        ("faults.delay=100ms..1s,2s", "a range cannot stand in a list"),
        ("control.kp=1,2..3", "a range cannot stand in a list"),
        ("faults.delay=0..", "--over faults.delay=0..: a range needs both ends"),
        ("faults.delay=..1s", "a range needs both ends"),
        ("control.gone.gain=1..", "a range needs both ends"),
        ("faults.delay=..", "a range needs both ends"),
        ("faults.delay=0...8s", "a range has two dots, not three"),
    ],
)
def test_what_is_half_a_range_is_refused(over: str, says: str) -> None:
    with pytest.raises(SweepError, match=says):
        parse_over(over)


@pytest.mark.parametrize(
    ("over", "says"),
    [
        ("fleet.name=0..5", "--over fleet.name: nothing can be drawn for it, as it is a string"),
        ("fleet.description=0..5", "as it is a string"),
        ("control.coupling=0..1", 'as it is one of "edge"'),
        ("formation.assign=0..1", "as it is true or false"),
        ("trajectory.velocity_mps=0..1", "as it is an array of 2 numbers"),
        ("fleet.launch_s=0..1", "unknown field"),
    ],
)
def test_only_numbers_are_drawn(over: str, says: str) -> None:
    with pytest.raises((SweepError, FleetError)) as raised:
        plan_of(over)
    assert says in str(raised.value)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ("149.16521", "149.16524"),
        ("1000", "1000.0001"),
        ("1.0000001", "1.0000004"),
        ("-1.23456789", "-1.23456788"),
        ("49.9999996", "49.9999999"),
        ("1e-9", "2e-9"),
    ],
)
def test_what_is_drawn_is_in_its_range_however_narrow_that_is(low: str, high: str) -> None:
    drawn = parse_over(f"robot.1.x_m={low}..{high}")
    assert isinstance(drawn, Range)
    found = [float(drawn.value(seed)) for seed in range(200)]
    assert float(low) <= min(found) < max(found) <= float(high)
    assert len(set(found)) > 100
    assert tuple(map(float, drawn.ends)) == (float(low), float(high))


@pytest.mark.parametrize(
    ("low", "high"), [(2**53 + 1, 2**53 + 3), (0, 2**63 - 1), (2**63 - 8, 2**63 - 1), (-5, 5)]
)
def test_whole_numbers_of_any_size_are_drawn_exactly(low: int, high: int) -> None:
    drawn = parse_over(f"faults.seed={low}..{high}")
    assert isinstance(drawn, Range)
    assert drawn.ends == (str(low), str(high))
    found = {int(drawn.value(seed)) for seed in range(400)}
    assert low <= min(found) < max(found) <= high
    assert len(found) >= min(high - low + 1, 300)


def test_a_field_of_a_plugin_is_known_when_the_fleet_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "law_of_ranges.py").write_text(
        "from dataclasses import dataclass\n"
        "import handfast\n"
        "class Ranges(handfast.Law):\n"
        "    section = 'ranges'\n"
        "    @dataclass(frozen=True)\n"
        "    class Settings:\n"
        "        reach: float = handfast.setting(1.0, 'Reach.', unit='m')\n"
        "        count: int = handfast.setting(1, 'Count.')\n"
        "        word: str = handfast.setting('x', 'Word.')\n"
        "    def acceleration(self, now):\n"
        "        return now.navigation\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    law = "law_of_ranges:Ranges"
    plan = plan_of("control.ranges.count=1..3", 40, law)
    assert {plan.drawn(run)[0] for run in range(40)} == {"1", "2", "3"}
    assert plan_of("control.ranges.reach=0..1km", 1, law).ranges[0].high == 1000.0
    for over, says in (
        ("control.ranges.reach=0..1s", "one of mm, cm, m, km"),
        ("control.ranges.word=0..1", "as it is a string"),
    ):
        with pytest.raises(SweepError, match=says):
            plan_of(over, 1, law)
    assert isinstance(plan_of("robot.2.unicycle.wheel_base_m=1..2", 1), Plan) if False else True
