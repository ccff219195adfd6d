"""Fleets from Python: loaded, changed, asked, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from handfast.agent.common.errors import Error
from handfast.agent.fleet.loading import load_fleet
from handfast.deploy.api.drive import run, simulate
from handfast.deploy.api.fleet import Fleet, check, fleets, load, refuse_errors, scenarios
from handfast.deploy.api.sweep import sweep
from handfast.deploy.console.data_files import FLEETS

DELTA = FLEETS / "delta.toml"


@pytest.mark.parametrize(
    "source",
    ["delta", DELTA, str(DELTA), DELTA.read_text(encoding="utf-8"), load("delta"), load("delta").toml()],
    ids=["name", "path", "path as text", "text", "fleet", "complete text"],
)
def test_a_fleet_is_loaded_from_whatever_names_or_is_one(source: Any) -> None:
    assert load(source).settings == load_fleet(DELTA)


def test_a_fleet_is_loaded_from_tables() -> None:
    import tomllib

    assert load(tomllib.loads(DELTA.read_text(encoding="utf-8"))).settings == load_fleet(DELTA)


def test_changes_are_those_of_the_command_line() -> None:
    fleet = load(
        "delta",
        {"control.kp": 2, "robot.3.mass_kg": 12.0, "faults.delay": "50ms"},
        law="paper",
        faults="partition",
        duration="20s",
        seed=7,
    )
    overrides = [
        "control.kp=2",
        "robot.3.mass_kg=12",
        "faults.delay=50ms",
        "fleet.duration_s=20s",
        "fleet.seed=7",
    ]
    scenario = FLEETS.parent / "scenarios" / "partition.toml"
    assert fleet.settings == load_fleet(DELTA, overrides, "paper", scenario)
    assert (fleet.duration_s, fleet.seed) == (20.0, 7)


def test_a_changed_fleet_is_another_one_and_a_later_change_wins() -> None:
    one = load("delta", {"control.kp": 2.0})
    other = one.with_({"control.kp": 3.0}, duration=5)
    assert (one["control.kp"], other["control.kp"], other.duration_s) == (2.0, 3.0, 5.0)
    assert repr(other) == "<Fleet delta: 6 robots, 5 s, control.kp=3.0, fleet.duration_s=5>"


def test_orders_and_scenarios_may_be_texts() -> None:
    fleet = load("delta", orders='[[order]]\nat = 5.0\nkind = "stop"\n', faults="[faults]\nloss = 0.1\n")
    assert [order.kind for order in fleet.settings.orders] == ["stop"]
    assert fleet["faults.loss"] == "10%"


def test_what_can_be_asked_of_a_fleet(tmp_path: Path) -> None:
    fleet = load("delta")
    assert (fleet.name, fleet.ids) == ("delta", (1, 2, 3, 4, 5, 6))
    assert fleet.edges[1, 2] == pytest.approx(1.0)
    assert len(fleet.edges) == 9
    assert fleet["robot.2.mass_kg"] == 10.0
    assert "6 robots" in str(fleet)
    assert load(fleet.save(tmp_path / "mine.toml")).settings == fleet.settings
    assert "delta" in fleets()
    assert "partition" in scenarios()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: load("nope"), "no bundled fleet of that name; there are: delta"),
        (lambda: load(""), "a fleet is a path, the name of a bundled one"),
        (lambda: load(None), "got NoneType"),  # type: ignore[arg-type]
        (lambda: load({"fleet": object()}), "the tables are no TOML"),
        (lambda: load("delta", {"control.kq": 1}), r"  control\.kq: unknown field"),
        (lambda: load("delta", {"control.kp": "x"}), r"  control\.kp: must be a number"),
        (lambda: load("delta", {1: 2}), "a field is named by a text"),  # type: ignore[dict-item]
        (lambda: load("delta", [1]), "changes are given by field"),  # type: ignore[arg-type]
        (lambda: load("delta", law="nope"), "  law: must be one of paper, edge"),
        (lambda: load("delta", faults="nope"), "no bundled scenario of that name"),
        (lambda: load("delta", faults={"delay": "1s"}), r'^faults must be a file .*"faults\.delay": "50ms"'),
        (lambda: load("delta", orders=3), r"^orders must be a file or a text \(TOML\), got 3$"),
        (lambda: load("delta", orders=0), r"^orders must be a file or a text \(TOML\), got 0$"),
        (lambda: load("delta", orders="nope"), "cannot read the file of orders"),
        (lambda: load("delta", duration="5 bananas"), r"  fleet\.duration_s: must be"),
        (
            lambda: load("delta")["control.kq"],
            r"control\.kq is not given, or is no field; there are coupling",
        ),
        (lambda: load("delta").save("/nowhere/x.toml"), "cannot write /nowhere/x.toml"),
    ],
)
def test_nonsense_is_said_in_one_error(make: Any, says: str) -> None:
    with pytest.raises(Error, match=says):
        make()


@pytest.mark.parametrize("call", [load, check, simulate, run, sweep], ids=lambda call: call.__name__)
def test_a_name_that_is_none_is_said_by_the_function_that_was_called(call: Any) -> None:
    head = rf"^handfast\.{call.__name__}\(\) got an unexpected keyword argument "
    with pytest.raises(TypeError, match=head + r"'durration'; did you mean duration\?$"):
        call("delta", durration=3)
    with pytest.raises(TypeError, match=head + "'jobs'; there are fleet, .*law, .*seed$"):
        call("delta", jobs=2)


def test_check_finds_what_the_command_finds_and_errors_are_refused() -> None:
    found = check("delta", {"control.kp": 300.0})
    assert [finding.level for finding in found] == sorted(
        (finding.level for finding in found), key=["error", "warning", "info"].index
    )
    assert [finding.place for finding in found.errors] == ["fleet.rate_hz"]
    assert any(finding.level == "warning" for finding in found)
    assert str(found).startswith("error: fleet.rate_hz: 50 Hz is too slow")
    with pytest.raises(
        Error, match=r"not started \(check=False drives all the same\):\n  fleet.rate_hz: 50 Hz"
    ):
        refuse_errors(load("delta", {"control.kp": 300.0}))


def test_a_fleet_may_be_made_of_a_text_alone() -> None:
    assert Fleet(DELTA.read_text(encoding="utf-8"), "mine").ids == (1, 2, 3, 4, 5, 6)
