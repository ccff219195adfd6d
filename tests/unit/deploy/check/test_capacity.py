"""How many robots a machine carries, and what is said about it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.analysis.shapes import lattice
from handfast.deploy.check.capacity import (
    FULL,
    ROBOTS_MIN,
    ROOMY,
    Machine,
    carried,
    check_capacity,
    cost_of,
    overload,
    that_fits,
    used,
)
from handfast.deploy.check.check import check

LAPTOP = Machine(2.0, 1.0)


def fleet(robots: int, rate_hz: float = 10.0) -> Fleet:
    return resolved(parse_fleet(lattice(f"lattice{robots}", robots, rate_hz=rate_hz), source="many"))


def test_small_fleets_are_never_too_many() -> None:
    slow = Machine(0.5, 0.05)
    assert overload(fleet(ROBOTS_MIN - 1), slow) == ""
    assert list(check_capacity(fleet(ROBOTS_MIN - 1), slow)) == []
    assert overload(fleet(ROBOTS_MIN), slow) != ""


def test_a_fleet_that_is_too_large_is_told_what_fits_and_that_fits() -> None:
    many, machine = fleet(100, 20.0), LAPTOP
    text = overload(many, machine)
    assert text.startswith("100 robots at 20 Hz need about ")
    assert f"this machine (2 cores) carries about {carried(many, machine)} robots like these at 20 Hz" in text
    fitting = that_fits(many, machine)
    assert fitting is not None
    changes = text.partition("--set ")[2].split(" --set ")
    assert changes[0] == f"fleet.rate_hz={fitting[0].fleet.rate_hz:g}"
    told = resolved(parse_fleet(lattice("lattice100", 100, rate_hz=20.0), source="x", overrides=changes))
    assert told == fitting[0]
    assert used(cost_of(told), machine) <= ROOMY
    assert [str(each) for each in check(told) if each.level == "error"] == []


@pytest.mark.parametrize(("robots", "speed"), [(45, 0.62), (60, 0.8), (77, 1.0), (70, 1.1)])
def test_what_is_proposed_is_not_refused_when_the_machine_is_measured_as_slower(
    robots: int, speed: float
) -> None:
    """By a second command, a minute later, with the settings that the first has printed."""
    checked, run = Machine(2.0, speed), Machine(2.0, speed / 1.15)
    many = fleet(robots, 20.0)
    (finding,) = check_capacity(many, checked)
    assert finding.message.startswith("`handfast run` refuses it here: ")
    changes = finding.message.partition("--set ")[2].split(" --set ")
    told = resolved(parse_fleet(lattice("many", robots, rate_hz=20.0), source="many", overrides=changes))
    (again,) = check_capacity(told, checked)
    assert again.level == "info"
    assert overload(told, run) == ""
    assert used(cost_of(many, carried(many, checked)), run) <= FULL, "as many as it is said to carry"


def test_where_no_rate_fits_it_says_so() -> None:
    text = overload(fleet(100), Machine(1.0, 0.05))
    assert text.endswith("; drive fewer, on a larger machine or in virtual time (`handfast simulate`)")
    assert "this machine (1 core) carries about " in text


def test_no_rate_is_proposed_at_which_check_finds_errors() -> None:
    stiff = fleet(100, 50.0)
    stiff = replace(stiff, control=replace(stiff.control, c1=60.0, c2=16.0))
    found = that_fits(stiff, Machine(2.0, 1.5))
    assert found is None or not any(each.level == "error" for each in check(found[0]))
    assert that_fits(stiff, LAPTOP) is None


def test_check_warns_of_what_run_refuses_and_says_what_fits_otherwise() -> None:
    (finding,) = check_capacity(fleet(130), LAPTOP)
    assert (finding.level, finding.place) == ("warning", "fleet.rate_hz")
    assert finding.message.startswith("`handfast run` refuses it here: 130 robots at 10 Hz need about ")
    (finding,) = check_capacity(fleet(24), Machine(8.0, 1.0))
    assert finding.level == "info"
    assert finding.message.startswith("this machine (8 cores) carries about ")
