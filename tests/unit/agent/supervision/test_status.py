"""handfast.agent.supervision.state_machine: when an agent says it, what it tells, and that it fits."""

from __future__ import annotations

from itertools import pairwise

import pytest

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.types import (
    TEXT_MAX,
    Stop,
)
from handfast.agent.supervision.state_machine import State
from tests.unit.agent.agent_bench import (
    PERIOD,
    STOP,
    Bench,
)


def test_status_comes_five_times_a_second_and_at_every_change():
    bench = Bench()
    bench.drive()
    statuses = [(k, out.status) for k, out in enumerate(bench.run(100)) if out.status is not None]
    assert all(after - before == 10 for (before, _), (after, _) in pairwise(statuses))
    bench.plant = {"healthy": False}
    out = bench.tick()
    assert out.status.state == "fault"
    bench.plant = {}
    states = [out.status.state for out in bench.run(2)]
    assert states == ["waiting", "running"]


def test_status_tells_times_ages_and_counters():
    bench = Bench()
    bench.drive()
    for _ in range(30):
        bench.tick()
        bench.agent.timed(123_456, 2)
    status = next(out.status for out in bench.run(10) if out.status is not None)
    assert status.robot == 1
    assert set(status.tick_us) == {123}
    assert set(status.ages_us) == {PERIOD // 1000}
    assert [neighbour[:2] for neighbour in status.neighbours] == [(2, PERIOD // 1000)]
    counters = dict(status.counters)
    assert counters["overruns"] == 60
    assert (
        counters["sent"]
        == counters["received"]
        == bench.ticks - (bench.now // PERIOD - status.time_ns // PERIOD) + 1
    )
    assert (counters["lost"], counters["delayed"], counters["duplicated"], counters["rejected"]) == (
        0,
        0,
        0,
        0,
    )


def test_status_fits_however_long_the_reasons_are():
    """A text of the wire has TEXT_MAX bytes: what is put before it must not push it beyond."""
    bench = Bench()
    bench.drive()
    bench.plant = {"healthy": False, "note": "n" * TEXT_MAX}
    bench.tick()
    bench.plant = {}
    bench.run(2)
    bench.give(STOP, Stop(1, bench.now, "é" * (TEXT_MAX // 2)))
    bench.run(3)
    assert bench.state is State.STOPPED


def star(spokes: int) -> Fleet:
    robots = ", ".join(f"{{ id = {9000 + k}, x_m = {2 * k}, y_m = 0 }}" for k in range(spokes))
    edges = ", ".join(f"[1, {9000 + k}]" for k in range(spokes))
    offsets = ", ".join(f"[{2 * k + 1}, 1]" for k in range(spokes))
    text = f"""
    robot = [{{ id = 1, x_m = -2, y_m = 0 }}, {robots}]
    fleet = {{ name = "two" }}
    formation = {{ edges = [{edges}], offsets = [[0, 0], {offsets}], safe_distance_m = 0.2 }}
    """
    return parse_fleet(text, source="here")


@pytest.mark.parametrize("spokes", [10, 20, 40, 64])
def test_status_fits_however_many_neighbours_there_are(spokes: int):
    bench = Bench(made=star(spokes))
    bench.other = None
    bench.run(30)
    assert bench.last.state == "waiting"
    assert bench.last.reason.startswith("silent neighbours: robot 9000")
    assert len(bench.last.neighbours) == spokes


def test_a_link_that_is_opened_anew_is_counted_and_said_for_a_while():
    bench = Bench()
    bench.drive()
    assert "links.opened_anew" not in dict(next(out.status for out in bench.run(20) if out.status).counters)
    bench.agent.link_opened_anew(bench.now, "was deaf to robot 2: link opened anew")
    statuses = [out.status for out in bench.run(400) if out.status is not None]
    said = [status.reason for status in statuses if "was deaf to robot 2: link opened anew" in status.reason]
    assert 24 <= len(said) <= 25  # five seconds
    assert "deaf" not in statuses[-1].reason
    assert dict(statuses[-1].counters)["links.opened_anew"] == 1
