"""A random scenario from a seed: a whole fleet file, as tables.

A scenario contains what handfast claims to survive, and no more. The seed chooses a preset
(`tests.chaos.presets`), whose weights say which features are drawn, and how.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from itertools import count, islice
from math import pi
from typing import Final

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.safety import BEACON_HORIZONS, AvoidanceSection
from handfast.agent.formation.geometry import resolved
from handfast.agent.formation.trajectory import make_trajectory
from handfast.deploy.check.braking import MARGIN_M
from handfast.deploy.check.check import check
from tests.chaos.dice import Dice, Tables
from tests.chaos.faults import FAULTS, draw_late
from tests.chaos.layout import (
    SHAPES,
    START_FACTOR,
    apart_m,
    draw_anywhere,
    draw_course,
    draw_crossing,
    draw_fence,
    draw_near,
    draw_obstacles,
    log_between,
    robot_rows,
    turned,
)  # fmt: skip
from tests.chaos.orders import draw_orders, draw_swaps
from tests.chaos.presets import PRESETS
from tests.chaos.scene import Scene
from tests.chaos.text import scenario_text

_MASS_KG: Final = 10.0
_INERTIA_KGM2: Final = 0.13
_TIMEOUT_S: Final = 0.2
"""Default timeout of plants and wrenches."""
_WIPED: Final = 0.3
"""Probability that a killed process loses its disk and starts again without its orders."""
_SLOW_BEACONS: Final = 0.3
"""Share of the fleets that send beacons as seldom as large fleets do."""
_PRESS_S: Final = 40.0
"""Time in which a formation forms, besides the time to drive there twice."""


def name_of(seed: int) -> str:
    """Return the name of a scenario, of its fleet and of its file."""
    return f"chaos-{seed}"


def preset_of(seed: int) -> str:
    """Return the preset of a seed for which none is named."""
    return Dice("preset", seed).weighted([(name, each.weight) for name, each in PRESETS.items()])


def seeds_of(preset: str | None, first: int, number: int) -> list[int]:
    """Return the first seeds from `first` on, of one preset if one is named."""
    found: Iterator[int] = (seed for seed in count(first) if preset in (None, preset_of(seed)))
    return list(islice(found, number))


def draw(seed: int) -> Tables:
    """Return the tables of the fleet file of this seed, in which `handfast check` finds no error."""
    for attempt in count():
        tables = _draw(seed, Dice("scenario", seed, attempt), preset_of(seed))
        findings = check(resolved(parse_fleet(scenario_text(tables), source="scenario")))
        # Where nothing happens, the fleet has to be able to keep up with its course.
        too_fast = "faults" not in tables and any(each.place.startswith("trajectory.") for each in findings)
        if not too_fast and not any(each.level == "error" for each in findings):
            return tables
    raise AssertionError


def _draw(seed: int, dice: Dice, name: str) -> Tables:
    scene, tables = _begun(dice, name)
    preset, course_mps = scene.preset, dice.between(*PRESETS[name].course_share) * scene.speed
    features = [feature for feature in FAULTS if dice.chance(preset.faults.get(feature, 0.0))]
    if "late" in features:
        draw_late(scene)
    _place(scene, course_mps, room_m=scene.late_s * (scene.speed if "restarts" in features else 0.2))
    for feature in features:
        FAULTS[feature](scene)
    if "swaps" in preset.orders:
        draw_swaps(scene)
    # Orders come while something is wrong.
    scene.trouble_s = scene.last_s or scene.trouble_s
    ends_s = scene.trouble_s if "any" in preset.orders else scene.last_s
    side = max(3.0, 1.2 * scene.shape.span, 2.5 * START_FACTOR * scene.safe_m * len(scene.ids) ** 0.5)
    calm_s = max(preset.calm_s, _PRESS_S + 2.0 * side / scene.speed if not scene.rules else 0.0)
    duration_s = max(ends_s + dice.weighted(preset.quiet_s), 0.0 if scene.last_s else calm_s)
    tables["fleet"] = {
        "name": name_of(seed), "rate_hz": scene.rate_hz, "duration_s": round(duration_s, 1), "seed": seed,
    }  # fmt: skip
    course = dice.weighted(preset.courses)
    tables["trajectory"] = draw_course(
        dice, course, (0.0, 0.0), course_mps, course_mps * duration_s, scene.shape
    )
    starts = dice.weighted(preset.starts)
    if not scene.starts:
        _start(scene, starts, side)
    tables["robot"] = robot_rows(dice, scene.starts, scene.reserve, scene.reach_m)
    _finish(scene, tables)
    return tables


def _begun(dice: Dice, name: str) -> tuple[Scene, Tables]:
    """Draw members, rate, limits and bodies."""
    preset = PRESETS[name]
    number = preset.robots[0] + int((preset.robots[1] - preset.robots[0] + 1) * dice.share() ** 1.2)
    ids = list(range(1, number + dice.whole(*preset.spares) + 1))
    reserve = dice.some(ids, len(ids) - number)
    rate_hz, size = dice.weighted(preset.rates_hz), dice.between(*dice.weighted(preset.size))
    safe_m, speed = round(size * dice.between(*preset.safe_m), 2), dice.between(*preset.speed_mps)
    acceleration = round(size**0.5 * dice.between(*preset.acceleration), 1)
    speed = round(size**0.5 * speed, 2)
    if preset.follow:
        acceleration = max(acceleration, round(2.0 * speed, 1))
    # The hand of a fast robot at a low rate has to be further out, so that the body can turn.
    turn_rad = 0.3 if rate_hz >= 10 else 0.45
    reach_m = round(max(dice.between(*preset.reach_m), speed / (turn_rad * rate_hz)), 2)
    members = [robot for robot in ids if robot not in reserve]
    trouble_s = dice.between(*preset.trouble_s, 1)
    scene = Scene(dice, preset, rate_hz, safe_m, speed, acceleration, reach_m, members, reserve, trouble_s)
    scene.timeout_periods = dice.weighted(preset.timeout_periods)
    tables: Tables = deepcopy({key: dict(table) for key, table in preset.tables.items()})
    if "any" in preset.faults and dice.chance(preset.deadman):
        tables["supervision"] = {"deadman_s": dice.between(0.5, 2.0, 1)}
    if dice.chance(preset.hold):
        tables.setdefault("supervision", {})["silence"] = "hold"
    return scene, tables


def _place(scene: Scene, course_mps: float, room_m: float) -> None:
    """Draw the formation, and starts where the formation decides them.

    Args:
        room_m: what robots that follow others need because messages are late.
    """
    dice, preset = scene.dice, scene.preset
    shape = dice.weighted(preset.shapes)
    if shape == "crossing":
        number = len(scene.members)
        first = dice.some(scene.members, dice.whole(max(1, number - 3), min(3, number - 1)))
        scene.groups = first, [robot for robot in scene.members if robot not in first]
        scene.starts, scene.shape, path_m = draw_crossing(dice, scene.groups, scene.safe_m)
        scene.meet_s = path_m / scene.speed + 3.0
        return
    spacing = dice.between(*preset.spacing) * apart_m(scene.safe_m)
    if preset.spacing_m:
        spacing = log_between(dice, *dice.weighted(preset.spacing_m))
    if preset.safe_share[1]:
        scene.safe_m = round(min(1.0, dice.between(*preset.safe_share) * spacing), 3)
        scene.reach_m = round(min(0.3, max(0.05, 0.4 * scene.safe_m)), 3)
        scene.speed = round(min(scene.speed, 0.45 * scene.reach_m * scene.rate_hz), 2)
    if preset.follow:
        # (F4) of docs/theory.md: a robot brakes when it has noticed that the one ahead brakes.
        braking_m = course_mps / min(3.0, scene.acceleration / scene.speed)
        behind_m = scene.safe_m + AvoidanceSection().margin_m + room_m + braking_m
        spacing = max(spacing, 1.05 * behind_m)
    scene.shape = SHAPES[shape](dice, scene.members, spacing)


def _start(scene: Scene, starts: str, side: float) -> None:
    dice, offsets = scene.dice, scene.shape.offsets
    apart = START_FACTOR * scene.safe_m
    if starts == "opposite":
        scene.starts = {robot: turned(place, pi) for robot, place in offsets.items()}
    elif starts == "swapped":
        left = list(offsets.values())
        places = {robot: left.pop(dice.whole(0, len(left) - 1)) for robot in offsets}
        scene.starts = draw_near(dice, places, scene.preset.scatter_m, apart)
    elif starts == "near":
        scene.starts = draw_near(dice, offsets, scene.preset.scatter_m, max(apart, scene.preset.apart_m))
    elif starts == "in place" and not scene.reserve:
        scene.starts = dict(offsets)
    else:
        scene.starts = draw_anywhere(dice, scene.ids, side, apart)


def _finish(scene: Scene, tables: Tables) -> None:
    """Fill in all other tables."""
    dice, preset, fleet = scene.dice, scene.preset, tables["fleet"]
    tables["formation"] = {
        "edges": [list(edge) for edge in scene.shape.edges],
        "offsets": [list(scene.shape.offsets[robot]) for robot in scene.members],
        "safe_distance_m": scene.safe_m,
        "assign": dice.chance(preset.assign),
    }
    tables["control"] = _control(scene) | tables.get("control", {})
    tables["robot_defaults"] = _body(scene, tables) | tables.get("robot_defaults", {})
    _slow_beacons(scene, tables)
    if dice.chance(preset.obstacles):
        trajectory = make_trajectory(parse_fleet(scenario_text(tables), source="scenario").trajectory)
        course = [trajectory.at(float(t))[:2] for t in range(int(fleet["duration_s"]))]
        obstacles = draw_obstacles(dice, list(scene.starts.values()), scene.safe_m, course)
        tables |= {"obstacle": obstacles} if obstacles else {}
    if "any" in preset.orders:
        extent = draw_orders(scene, tables)
        if dice.chance(preset.fence):
            tables["geofence"] = draw_fence(dice, extent)
    if scene.orders:
        tables["order"] = sorted(scene.orders, key=lambda order: float(order["at"]))
    for rule in scene.rules:
        if ("kill" in rule or "restart" in rule) and dice.chance(_WIPED):
            rule["wipe"] = True
    if scene.rules:
        tables["faults"] = {"rule": scene.rules}


def _control(scene: Scene) -> Tables:
    dice, preset, rate_hz = scene.dice, scene.preset, scene.rate_hz
    control: Tables = {
        "coupling": dice.weighted((("joint", 4.0), ("edge", 1.0))),
        "max_speed_mps": scene.speed,
        "max_acceleration": scene.acceleration,
    }
    timeout_s = round(scene.timeout_periods / rate_hz, 2)
    if timeout_s > _TIMEOUT_S:
        control |= {"plant_timeout_s": timeout_s, "wrench_timeout_s": timeout_s}
    if scene.timeout_periods >= preset.rate_min:
        control["rate_min_hz"] = 0.5 * rate_hz
    if rate_hz < 4:
        control["prediction_horizon_s"] = round(8.0 / rate_hz, 1)
    elif dice.chance(preset.horizon):
        control["prediction_horizon_s"] = dice.between(1.0, 3.0, 1)
    return control


def _body(scene: Scene, tables: Tables) -> Tables:
    """Draw ``[robot_defaults]``. Bodies brake as they may accelerate: the safety filter counts on that."""
    dice, reach_m, (limits, lag, noise) = scene.dice, scene.reach_m, scene.preset.bodies
    inertia = _INERTIA_KGM2
    if reach_m > 0.3:  # a body as long as its hand is far ahead
        inertia = round(_MASS_KG * (0.3 * reach_m) ** 2 + inertia, 2)
    body: Tables = {"mass_kg": _MASS_KG, "inertia_kgm2": inertia, "hand_offset_m": reach_m}
    if dice.chance(limits):
        enough = dice.between(1.0, 2.0) * scene.acceleration
        body["max_force_n"] = round(enough * _MASS_KG, 1)
        body["max_torque_nm"] = round(enough * inertia / reach_m + 0.01, 2)
    if dice.chance(lag):
        # The safety filter does not know of the lag: its margin has to allow for it.
        lag_s = dice.between(0.0, 0.1 if scene.rate_hz >= 20 else 0.5 / scene.rate_hz)
        body["actuator_lag_s"] = lag_s
        tables["avoidance"] = {"margin_m": round(MARGIN_M + lag_s * scene.speed, 3)}
    if dice.chance(noise):
        body |= {
            "position_noise_m": dice.between(0.0, 0.005, 4), "heading_noise_rad": dice.between(0.0, 0.01, 4),
        }  # fmt: skip
    if "mavlink" in tables.get("robot_defaults", {}):
        tables["robot_defaults"]["mavlink"] |= {"max_speed_mps": scene.speed}
    return body


def _slow_beacons(scene: Scene, tables: Tables) -> None:
    """Have some fleets send beacons as seldom as fleets of many robots do, or still more seldom."""
    dice = scene.dice
    if dice.chance(_SLOW_BEACONS):
        longest_s = dice.between(0.4, min(2.0, tables["control"].get("prediction_horizon_s", 2.0)), 1)
        if dice.chance(0.3):
            longest_s = round(BEACON_HORIZONS * longest_s, 1)
        tables.setdefault("avoidance", {})["beacon_interval_max_s"] = longest_s
