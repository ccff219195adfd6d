"""What `check` says of a radio's budget, and that what it proposes fits."""

from __future__ import annotations

import shlex
from typing import Final

import pytest

from agent.fleet.loading import load_fleet, parse_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve
from deploy.analysis.lattice import lattice
from deploy.check.check import check
from deploy.check.description import describe
from deploy.check.finding import Finding
from deploy.check.load.radio import check_radio, fitting_rates, with_rates
from deploy.check.load.radio_load import worst_load
from deploy.console.data_files import FLEETS

PLACE: Final = "network.budget"


def fleet(*sets: str, name: str = "delta") -> Fleet:
    return load_fleet(FLEETS / f"{name}.toml", ["fleet.rate_hz=20", *sets])


def found(there: Fleet) -> list[Finding]:
    return list(check_radio(there, resolve(there)))


def proposed(finding: Finding, operator: bool = False) -> list[str]:
    """The overrides that a finding says, as a shell has them."""
    text = finding.message.split("this fits: ")[1]
    alone, _, watched = text.partition("; while an operator listens to all, this: ")
    words = shlex.split((watched if operator else alone).partition(" (but")[0])
    assert words[::2] == ["--set"] * len(words[::2])
    return words[1::2]


def test_without_a_budget_nothing_is_said() -> None:
    assert found(fleet()) == []
    assert "radio:" not in describe(fleet())


def test_enough_is_said_in_a_line() -> None:
    there = fleet('network.budget="1 Mbit/s"')
    assert found(there) == []
    (line,) = (line for line in describe(there).splitlines() if "radio:" in line)
    assert line.startswith("  radio: robot ")
    assert "of 1 Mbit/s each way; while an operator listens to all, robot" in line
    assert describe(fleet('network.budget="1 Mbit/s"', "network.emulate_budget=true")).count("emulated") == 1


@pytest.mark.parametrize("budget", [150, 100, 60])
@pytest.mark.parametrize("operator", [False, True])
def test_too_little_is_warned_of_and_the_line_to_copy_fits(budget: int, operator: bool) -> None:
    sets = f"network.budget={1000 * budget}"
    (finding,) = found(fleet(sets))
    assert (finding.level, finding.place) == ("warning", PLACE)
    assert f"where {budget} kbit/s are to do each way" in finding.message
    there = fleet(sets, *proposed(finding, operator))
    assert worst_load(there, resolve(there), operator=operator).most <= 1000 * budget
    rate = there.fleet.rate_hz
    faster = fleet(
        sets,
        *(f"fleet.rate_hz={rate + 1}" if "rate_hz" in each else each for each in proposed(finding, operator)),
    )
    assert worst_load(faster, resolve(faster), operator=operator).most > 1000 * budget, "the highest rate"


def test_enough_for_robots_but_not_for_an_operator_is_warned_of() -> None:
    needed, watched = (worst_load(fleet(), resolve(fleet()), operator=each).most for each in (False, True))
    sets = f"network.budget={(needed + watched) / 2}"
    (finding,) = found(fleet(sets))
    assert finding.level == "warning"
    assert "but not what an operator who listens to all adds" in finding.message
    there = fleet(sets, *proposed(finding))
    assert [each for each in found(there) if each.level == "warning"] == []


def test_a_fleet_that_would_not_catch_up_is_told_of() -> None:
    there = load_fleet(FLEETS / "lattice45.toml", ["network.budget=1000000"])
    (finding,) = found(there)
    assert (finding.level, finding.place) == ("info", PLACE)
    assert "beacons tell of up to 16 of them" in finding.message


def test_a_low_rate_has_longer_timeouts_and_is_said_to_be_low() -> None:
    (finding,) = found(fleet("network.budget=30000"))
    there = fleet("network.budget=30000", *proposed(finding))  # it is valid
    assert there.control.plant_timeout_s >= 2.0 / there.fleet.rate_hz
    assert "(but the law wants a higher rate)" in finding.message


def test_where_no_rate_fits_it_says_what_might() -> None:
    """Also where one would at which the law is not stable."""
    for budget in (3000, 20000):
        (finding,) = found(fleet(f"network.budget={budget}"))
        assert finding.message.endswith(
            "no rate that the law carries fits: take fewer robots or edges, or more budget"
        )


@pytest.mark.slow
def test_where_a_mesh_never_fits_routers_are_proposed() -> None:
    # Signs of life on forty idle links take more than all that is said.
    sets = ("avoidance.sensing_m=1.2", "network.budget=60000")
    there = fleet(*sets, 'network.topology="mesh"', name="lattice45")
    assert fitting_rates(there, resolve(there), operator=False) is None
    routed = fleet(*sets, 'network.topology="routed"', name="lattice45")
    assert fitting_rates(routed, resolve(routed), operator=False) is not None
    assert found(there)[0].message.endswith("every listener gets a copy of its own: use routers")


def test_fewer_beacons_are_proposed_before_a_rate_that_is_low() -> None:
    there = load_fleet(
        FLEETS / "lattice45.toml", ["network.budget=200000", "avoidance.beacon_interval_max_s=0.9"]
    )
    sets = fitting_rates(there, resolve(there), operator=False)
    assert sets is not None
    assert sets["fleet.rate_hz"] >= 10
    assert sets["avoidance.beacon_interval_max_s"] == 2.0


def test_a_large_fleet_is_proposed_a_longer_interval_between_beacons() -> None:
    """At 5 Hz 103 kbit/s were too much, and no fewer beacons a second than one are said where all is new."""
    there = parse_fleet(lattice("many", 45, rate_hz=10.0), source="here", overrides=["network.budget=100000"])
    sets = fitting_rates(there, resolve(there), operator=False)
    assert sets == {"fleet.rate_hz": 5, "avoidance.beacon_interval_max_s": 4.0}
    assert worst_load(with_rates(there, sets), resolve(there)).most <= 100_000


def test_robots_with_radios_of_their_own_are_warned_of_an_emulated_one() -> None:
    hosts = ("host={ a = {}, b = {} }", 'robot.1.host="a"', 'robot.2.host="b"')
    sets = ("network.budget=10000000", "network.emulate_budget=true", *hosts)
    (finding,) = found(fleet(*sets, name="pair"))
    assert (finding.level, finding.place) == ("warning", "network.emulate_budget")


def test_check_looks_at_it() -> None:
    assert PLACE in {each.place for each in check(fleet("network.budget=50000"))}
