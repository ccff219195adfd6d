"""What a fleet file says of how processes run on their computers."""

from __future__ import annotations

import pytest
import tomli_w

from handfast.agent.fleet.hosts import LINKS_PRIORITY, PRIORITIES
from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from tests.unit.agent.fleet.test_hosts import FLEET


def fleet(more: str = "") -> Fleet:
    return parse_fleet(FLEET % (more, "", ""), source="here")


def test_nobody_asks_for_real_time_who_does_not_say_so() -> None:
    assert not fleet().process.realtime
    assert not fleet("[process]\ncpus = [1]").process.realtime


def test_a_plant_is_above_its_agent_and_both_are_above_their_links() -> None:
    assert LINKS_PRIORITY < PRIORITIES["agent"] < PRIORITIES["plant"] < 50


def test_cores_are_numbers_and_bad_ones_are_named() -> None:
    assert fleet("[process]\ncpus = [2, 3]").process.cpus == (2, 3)
    with pytest.raises(FleetError, match=r"process.cpus\[2\]: must be between 0 and 1023, got -1"):
        fleet("[process]\ncpus = [0, -1]")
    with pytest.raises(FleetError, match=r"process.cpus: core 2 is given twice"):
        fleet("[process]\ncpus = [2, 3, 2]")


def test_robots_need_not_agree_on_it_and_it_comes_back_from_its_file() -> None:
    asks = fleet("[process]\nrealtime = true\ncpus = [0]")
    assert digest(asks) == digest(fleet())
    assert parse_fleet(tomli_w.dumps(to_dict(asks)), source="again") == asks
