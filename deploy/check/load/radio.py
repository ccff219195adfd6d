"""Whether what the robots' radios carry fits into `network.budget`, and which rates do (PURE)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

from agent.fleet.hosts import MESH_ROBOTS_MAX
from agent.fleet.model import Fleet
from agent.fleet.safety import BEACON_HORIZONS
from agent.formation.geometry import Geometry
from agent.messages.types import SILENT_MAX
from deploy.check.finding import Finding
from deploy.check.load.radio_load import kbit, worst_load
from deploy.check.loop import check_loop

_GOOD_HZ: Final = 10.0
"""A lower rate than this is not proposed while beacons can be fewer."""
_BEACON_HZ: Final = (2.0, 1.0, 0.5)
_BEACON_INTERVALS_S: Final = (2.0, 4.0)
"""Fewer beacons that are proposed: while something is new, and while nothing is."""
_PERIODS: Final = 2.5
"""Timeouts of plant and wrench at a rate at which they would be shorter than the least that is allowed."""


def describe_radio(fleet: Fleet, geometry: Geometry) -> Iterator[str]:
    """What the busiest radio carries, in a line; nothing without a budget."""
    if fleet.network.budget is None:
        return
    alone = worst_load(fleet, geometry)
    watched = worst_load(fleet, geometry, operator=True)
    yield (
        f"radio: {alone}, of {kbit(fleet.network.budget)} each way; while an operator listens to all, "
        f"{watched}" + ("; emulated" if fleet.network.emulate_budget else "")
    )


def check_radio(fleet: Fleet, geometry: Geometry) -> Iterator[Finding]:
    """Warns of messages that the budget does not carry, and says which rates fit."""
    budget = fleet.network.budget
    if budget is None:
        return
    place = "network.budget"
    alone = worst_load(fleet, geometry)
    watched = worst_load(fleet, geometry, operator=True)
    if alone.most > budget:
        yield Finding(
            "warning",
            place,
            f"{alone} with all headers, where {kbit(budget)} are to do each way: messages will queue, come "
            f"late and be lost; {_advice(fleet, geometry)}",
        )
    elif watched.most > budget:
        yield Finding(
            "warning",
            place,
            f"{kbit(budget)} each way carry what robots say to each other, but not what an operator who "
            f"listens to all adds, as `handfast drive` does to record it: {watched}; "
            f"{_advice(fleet, geometry, operator=True)}",
        )
    else:
        stressed = worst_load(fleet, geometry, silences=True)
        if stressed.most > budget:
            yield Finding(
                "info",
                place,
                f"while robots are silent, others' beacons tell of up to {SILENT_MAX} of them: {stressed} "
                f"then, of {kbit(budget)} each way. A fleet whose radios fall behind may not catch up",
            )
    if fleet.network.emulate_budget and any(robot.host is not None for robot in fleet.robots):
        yield Finding(
            "warning",
            "network.emulate_budget",
            "robots with a host have radios of their own: on these the emulated one comes on top",
        )


def _advice(fleet: Fleet, geometry: Geometry, *, operator: bool = False) -> str:
    sets = fitting_rates(fleet, geometry, operator=operator)
    if sets is None:
        routed = replace(fleet, network=replace(fleet.network, topology="routed"))
        if not fleet.is_routed and fitting_rates(routed, geometry, operator=operator) is not None:
            return "no rate fits in a mesh, where every listener gets a copy of its own: use routers"
        return "no rate that the law carries fits: take fewer robots or edges, or more budget"
    text = f"this fits: {_words(fleet, geometry, sets)}"
    if not operator:
        watched = fitting_rates(fleet, geometry, operator=True)
        if watched is not None and watched != sets:
            text += f"; while an operator listens to all, this: {_words(fleet, geometry, watched)}"
    return text


def _words(fleet: Fleet, geometry: Geometry, sets: Mapping[str, float]) -> str:
    words = " ".join(f"--set {name}={value:g}" for name, value in sets.items())
    if len(fleet.robots) > MESH_ROBOTS_MAX:
        return words  # to look takes seconds; whoever checks it with these is told
    found = check_loop(with_rates(fleet, sets), geometry)
    unsound = any(each.place == "fleet.rate_hz" for each in found)
    return f"{words} (but the law wants a higher rate)" if unsound else words


def fitting_rates(fleet: Fleet, geometry: Geometry, *, operator: bool) -> dict[str, float] | None:
    """Settings with the highest rate (of `_lower_rates`) at which the budget carries everything; None if
    there is none, or none at which the law is stable (which is looked at in small fleets).

    Beacons become fewer where the rate would have to be below `_GOOD_HZ` otherwise.
    """
    budget = fleet.network.budget
    assert budget is not None
    best: dict[str, float] | None = None
    enough = min(_GOOD_HZ, fleet.fleet.rate_hz)
    for beacons in _fewer_beacons(fleet):
        # Not by halving: at low rates robots brake later, so they listen to each other from further away.
        for rate in _lower_rates(fleet.fleet.rate_hz):
            if best is not None and rate <= best["fleet.rate_hz"]:
                break
            sets = _settings(fleet, rate, beacons)
            if worst_load(with_rates(fleet, sets), geometry, operator=operator).most <= budget:
                if not _is_unstable(fleet, geometry, sets):
                    best = sets
                break
        if best is not None and best["fleet.rate_hz"] >= enough:
            break
    return best


def _is_unstable(fleet: Fleet, geometry: Geometry, sets: Mapping[str, float]) -> bool:
    """Whether the law is; not looked at in a large fleet, where that takes seconds."""
    if len(fleet.robots) > MESH_ROBOTS_MAX:
        return False
    found = check_loop(with_rates(fleet, sets), geometry)
    return any(each.place == "fleet.rate_hz" and each.level == "error" for each in found)


def _fewer_beacons(fleet: Fleet) -> Iterator[dict[str, float]]:
    """Settings for fewer and fewer beacons, the first for as many as there are."""
    yield {}
    rate, longest_s = "avoidance.beacon_hz", "avoidance.beacon_interval_max_s"
    now_s = fleet.beacon_rounds_max * fleet.period_ns / 1e9
    most_s = BEACON_HORIZONS * fleet.control.prediction_horizon_s
    intervals = [each for each in _BEACON_INTERVALS_S if now_s < each <= most_s]
    yield from ({longest_s: each} for each in intervals)
    for hz in _BEACON_HZ:
        if hz < fleet.avoidance.beacon_hz:
            yield {rate: hz}
            yield from ({rate: hz, longest_s: each} for each in intervals[-1:] if each >= 1.0 / hz)


def _lower_rates(rate_hz: float) -> Iterator[int]:
    """Rates to try, the highest first: in steps of about a twentieth, whole numbers."""
    rate = int(rate_hz)
    while rate >= 1:
        yield rate
        rate -= max(1, rate // 20)


def _settings(fleet: Fleet, rate_hz: float, beacons: Mapping[str, float]) -> dict[str, float]:
    """What has to be set for a rate, with these settings of beacons."""
    sets = {"fleet.rate_hz": rate_hz, **beacons}
    for name in ("plant_timeout_s", "wrench_timeout_s", "prediction_horizon_s"):
        if getattr(fleet.control, name) < 2.0 / rate_hz:
            sets[f"control.{name}"] = _PERIODS / rate_hz
    return sets


def with_rates(fleet: Fleet, sets: Mapping[str, float]) -> Fleet:
    """The fleet with numbers of its tables set, by TABLE.FIELD."""
    for name, value in sets.items():
        table, _, attribute = name.partition(".")
        fleet = replace(fleet, **{table: replace(getattr(fleet, table), **{attribute: value})})
    return fleet
