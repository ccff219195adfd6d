"""Whole fleets whose robots send hand states at events: as safe and as exact as with one in every period, on
links that fail too, for a tenth of the messages once they have settled."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.recording.collector import RunData
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.verdict.run_result import RunResult
from tests.simulation.link_audit import audit

EVENT = 'control.send="event"'
LINKS = {
    "clean": (),
    "late": ("faults.delay=100ms 20ms", "faults.loss=20%"),
    "bad": ("faults.delay=200ms", "faults.loss=30%"),
}
SETTLED_S = 10.0


def fleet(name: str, *overrides: str) -> Fleet:
    return resolved(load_fleet(fleet_path(name), overrides))


def drive(made: Fleet) -> tuple[RunResult, Callable[[float, float], float]]:
    """A drive, and how many of the periods in a time of it (from, to, s) had a hand state."""
    data = RunData(made, mode="simulate")
    hands = {key_expressions.hand(made.fleet.name, robot) for robot in made.ids}
    stamps_ns: list[int] = []

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        message = decode(payload)
        data.feed(received_ns, key, message)
        if key in hands:
            stamps_ns.append(message.time_ns)  # type: ignore[union-attr]

    simulation = Simulation(made, sink)
    simulation.run(lambda _: True)
    recording = data.recording(reasons=simulation.reasons)
    epoch_ns = recording.epoch_ns
    assert epoch_ns is not None

    def share(start_s: float, end_s: float) -> float:
        count = sum(start_s < (each - epoch_ns) / 1e9 <= end_s for each in stamps_ns)
        return count / ((end_s - start_s) * made.fleet.rate_hz * len(made.ids))

    return RunResult(recording), share


@pytest.mark.slow
@pytest.mark.parametrize(
    "links", [pytest.param(k, marks=pytest.mark.long if number else ()) for number, k in enumerate(LINKS)]
)
def test_a_delta_forms_as_safely_and_as_exactly_for_a_tenth_of_the_messages(links: str):
    (periodic, _), (event, share) = (drive(fleet("delta", *LINKS[links], *more)) for more in ((), (EVENT,)))
    assert periodic.passed
    assert event.passed, event.reasons
    assert event.metrics["rms_distance_error_m"] < 1.1 * periodic.metrics["rms_distance_error_m"]
    assert event.metrics["min_distance_m"]["any"] > 0.95 * periodic.metrics["min_distance_m"]["any"]
    assert share(30.0 - SETTLED_S, 29.0) <= 0.1
    assert 0.15 < share(0.0, 5.0) < 0.8  # it is what it says that is less, not what it does


@pytest.mark.slow
def test_what_is_not_sent_is_not_lost_and_every_fate_is_as_the_rules_say():
    event, _ = drive(fleet("delta", EVENT, "faults.loss=20%", "fleet.duration_s=20"))
    messages = event.metrics["messages"]
    assert 0.12 < messages["lost"] / (messages["lost"] + messages["received"]) < 0.25
    found = audit(event.recording, event.analysis)
    assert (found.differing, found.unrecorded) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["kill", "pause"])
def test_an_agent_that_dies_or_hangs_is_missed_as_soon_as_ever(what: str):
    """In a settled formation, in which nobody had anything to say."""
    rule = f'faults.rule=[{{robot = 2, {what} = "agent", at = 20.0, for = 4.0}}]'
    (periodic, _), (event, _) = (
        drive(fleet("delta", "fleet.duration_s=30", rule, *more)) for more in ((), (EVENT,))
    )
    assert not event.violations["separation"]
    least = periodic.metrics["min_distance_m"]["any"]
    assert event.metrics["min_distance_m"]["any"] > 0.95 * least
