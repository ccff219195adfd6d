"""Presets: ranges and weights that scenarios are drawn with. Lengths in m, times in s, frame W."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from tests.chaos.dice import Choice, Range

Chances = Mapping[str, float]
"""Names of features with the probability of each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """Ranges, weights and probabilities of one kind of scenario. The defaults are those of ``mixed``.

    Attributes:
        weight: how often a seed has this preset, relative to the others.
        robots: number of members. spares: number of robots in reserve.
        size: factor of all lengths, whose root is that of speeds and accelerations.
        follow: place robots so far apart that one can brake behind another at the course's speed.
        spacing: minimum distance of two places in least distances; spacing_m in m instead, with safe_share
            of it as the safe distance.
        timeout_periods: timeouts of plants and wrenches. rate_min: from this many periods on, the fleet may
            drop to half its rate.
        horizon: probability of a prediction horizon of its own. bodies: of actuator limits, of lag,
        of noise.
        scatter_m: how far from their places robots start (``near``, ``swapped``).
            apart_m: minimum distance of two hands then.
        course_share: speed of the course in shares of the maximum speed.
        trouble_s: when orders and faults of the kind ``any`` end. quiet_s: time after the last event.
            calm_s: duration of a drive in which nothing happens.
        faults: features of `tests.chaos.faults`. orders: features of `tests.chaos.orders`.
        delay_ms, loss: of late links, ms and %. late_some: probability that only some links are late.
            late_for_s: how long, where that ends (late_ends).
        cut_s: when robots are cut off. cut_for_s: how long, where that ends (cut_ends).
        dies_s: when agents die. dead: how many. dead_both: probability that the plant dies as well.
            dead_stay: that none is replaced or sent away. forgotten: that a minute goes by after that.
        restart_s: when agents start again, after all deaths.
    """

    weight: float
    summary: str
    robots: tuple[int, int] = (2, 12)
    spares: tuple[int, int] = (0, 0)
    rates_hz: Choice[int] = ((20, 3.0), (25, 3.0), (30, 2.0), (40, 1.0), (50, 1.0))
    safe_m: Range = (0.2, 0.35)
    size: Choice[Range] = (((1.0, 1.0), 1.0),)
    speed_mps: Range = (0.7, 1.5)
    acceleration: Range = (1.5, 5.0)
    reach_m: Range = (0.1, 0.2)
    follow: bool = False
    spacing: Range = (1.0, 1.8)
    spacing_m: Choice[Range] = ()
    safe_share: Range = (0.0, 0.0)
    shapes: Choice[str] = (("graph", 0.6), ("lattice", 0.4))
    assign: float = 0.0
    timeout_periods: Choice[float] = ((2.5, 1.0),)
    rate_min: float = 99.0
    horizon: float = 0.0
    bodies: tuple[float, float, float] = (0.0, 0.0, 0.0)
    starts: Choice[str] = (("anywhere", 1.0),)
    scatter_m: float = 0.0
    apart_m: float = 0.0
    courses: Choice[str] = (("hold", 1.0), ("line", 3.0), ("circle", 2.0), ("waypoints", 2.0))
    course_share: Range = (0.1, 0.4)
    obstacles: float = 0.0
    fence: float = 0.0
    hold: float = 0.2
    deadman: float = 0.0
    trouble_s: Range = (8.0, 18.0)
    quiet_s: Choice[float] = ((21.0, 1.0),)
    calm_s: float = 40.0
    faults: Chances = field(default_factory=dict)
    orders: Chances = field(default_factory=dict)
    delay_ms: tuple[int, int] = (0, 0)
    loss: Range = (10.0, 50.0)
    late_some: float = 0.0
    late_ends: float = 0.0
    late_for_s: Range = (15.0, 35.0)
    cut_s: Range = (0.0, 1.0)
    cut_ends: float = 0.4
    cut_for_s: Range = (0.0, 8.0)
    dies_s: Range = (2.0, 15.0)
    dead: tuple[int, int] = (1, 2)
    dead_both: float = 0.2
    dead_stay: float = 0.2
    forgotten: float = 0.0
    restart_s: Range = (0.0, 8.0)
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


_DEAD: Final[dict[str, Any]] = {
    "robots": (3, 5), "spares": (0, 2), "rates_hz": ((10, 3.0), (12, 2.0), (15, 1.0), (20, 0.5)),
    "speed_mps": (0.5, 1.5), "horizon": 0.3, "assign": 0.5, "obstacles": 0.15, "quiet_s": ((25.0, 1.0),),
    "shapes": (("graph", 3.0), ("lattice", 2.0), ("rows", 3.0)),
    "starts": (("anywhere", 3.0), ("in place", 1.0)),
    "courses": (("hold", 2.0), ("to and fro", 5.0), ("circle", 2.0)),
}  # fmt: skip
_ROVER: Final = {"connection": "simulator", "max_acceleration": 0.8, "max_yaw_rate_radps": 1.0}

PRESETS: Final[Mapping[str, Preset]] = {
    "mixed": Preset(
        weight=3.0, summary="a little of everything, within half a minute",
        spares=(0, 3), safe_m=(0.2, 0.4), speed_mps=(0.5, 1.5), assign=0.5, horizon=0.3,
        bodies=(0.4, 0.3, 0.3),
        obstacles=0.6, fence=0.3, deadman=0.2, quiet_s=((12.0, 1.0), (21.0, 1.0)),
        faults={"any": 0.95}, orders={"any": 0.85},
    ),
    "cut off": Preset(
        weight=2.0, summary="groups that change places and do not hear each other",
        robots=(2, 6), rates_hz=((10, 2.0), (15, 3.0), (20, 2.0), (30, 0.5)), horizon=0.3,
        shapes=(("crossing", 1.0),), courses=(("hold", 7.0), ("line", 3.0)), course_share=(0.02, 0.15),
        faults={"cut": 1.0}, orders={"any": 0.25}, quiet_s=((21.0, 1.0),),
    ),
    "dead": Preset(
        weight=1.5, summary="agents that die for good, their bodies in the corridors of others",
        faults={"dead": 1.0}, forgotten=0.5, **_DEAD,
    ),
    "restarted": Preset(
        weight=1.0, summary="agents that start again a minute after others died",
        faults={"dead": 1.0, "restarts": 1.0}, forgotten=1.0, **_DEAD,
    ),
    "fast": Preset(
        weight=0.8, summary="courses near the maximum speed, all messages late and many lost",
        robots=(2, 8), rates_hz=((15, 2.0), (20, 3.0), (25, 2.0)), speed_mps=(0.8, 1.5), follow=True,
        assign=1.0,
        starts=(("near", 1.0),), scatter_m=0.7, courses=(("line", 7.0), ("circle", 3.0)), hold=0.0,
        course_share=(0.4, 0.9), calm_s=90.0, faults={"late": 1.0, "restarts": 0.25}, delay_ms=(0, 1000),
        loss=(1.0, 50.0), restart_s=(25.0, 50.0),
    ),
    "late": Preset(
        weight=0.7, summary="many that cross each other's paths while messages are late",
        robots=(4, 12), rates_hz=((10, 1.0), (15, 2.0), (20, 3.0), (25, 1.0)), shapes=(("ring", 1.0),),
        spacing=(1.1, 1.8), starts=(("opposite", 1.0),), courses=(("hold", 6.0), ("line", 4.0)),
        course_share=(0.05, 0.3), obstacles=0.15, calm_s=120.0, faults={"late": 1.0}, delay_ms=(300, 1000),
        late_some=0.3, late_ends=0.75,
    ),
    "low rate": Preset(
        weight=1.5, summary="2 to 15 Hz",
        robots=(2, 6), rates_hz=tuple((hz, 1.0) for hz in (2, 3, 4, 5, 6, 8, 10, 12, 15)),
        safe_m=(0.2, 0.6),
        speed_mps=(0.3, 1.5), assign=0.5, bodies=(0.0, 0.3, 0.0), hold=0.0, trouble_s=(6.0, 14.0),
        calm_s=90.0,
        quiet_s=((12.0, 1.0), (21.0, 1.0)), faults={"any": 0.5},
    ),
    "scale": Preset(
        weight=1.0, summary="places 0.3 to 10 m apart, and nothing happens",
        robots=(2, 9), rates_hz=((20, 2.0), (25, 1.0)), speed_mps=(0.5, 1.5), hold=0.0, assign=0.5,
        spacing_m=(((0.3, 10.0), 1.0), ((0.3, 0.8), 1.0)), safe_share=(0.2, 0.45),
        shapes=(("graph", 2.0), ("lattice", 8.0)), courses=(("hold", 4.0), ("line", 3.6), ("circle", 2.4)),
    ),
    "reordered": Preset(
        weight=0.5, summary="formations that change while some do not hear others",
        robots=(3, 6), rates_hz=((15, 1.0), (20, 3.0), (30, 1.0)),
        size=(((1.0, 1.0), 0.4), ((2.0, 5.0), 0.6)),
        horizon=0.3, shapes=(("row", 6.0), ("graph", 1.0), ("lattice", 1.0)), starts=(("in place", 1.0),),
        courses=(("hold", 6.0), ("line", 4.0)), course_share=(0.1, 0.3), quiet_s=((35.0, 1.0),),
        faults={"cut": 1.0}, orders={"swaps": 1.0}, cut_s=(0.5, 8.0), cut_ends=0.3, cut_for_s=(5.0, 20.0),
    ),
    "overloaded": Preset(
        weight=1.0, summary="processes that stall now and then amid others that go on",
        robots=(8, 16), rates_hz=((10, 3.0), (15, 1.0), (20, 1.0)), safe_m=(0.2, 0.3), speed_mps=(0.7, 1.2),
        acceleration=(1.5, 4.0), shapes=(("lattice", 1.0),), spacing_m=(((0.8, 1.2), 1.0),),
        timeout_periods=((3.0, 6.0), (10.0, 4.0)), starts=(("near", 1.0),), scatter_m=0.1, hold=0.0,
        courses=(("line", 3.0), ("circle", 7.0)), course_share=(0.3, 0.7),
        quiet_s=((0.0, 4.0), (21.0, 1.0)), faults={"stalls": 1.0, "late": 0.4}, delay_ms=(10, 150),
        loss=(0.5, 10.0), calm_s=20.0,
    ),
    "crowded": Preset(
        weight=0.5, summary="many in each other's places, messages late, some dead",
        robots=(20, 30), rates_hz=((10, 4.0), (15, 1.0)), safe_m=(0.2, 0.25), speed_mps=(0.6, 0.9),
        acceleration=(1.5, 4.0), shapes=(("patch", 1.0),), spacing_m=(((0.9, 1.1), 1.0),),
        timeout_periods=((2.5, 3.0), (4.5, 7.0)), rate_min=4.5, starts=(("swapped", 1.0),), scatter_m=0.12,
        hold=0.0, courses=(("hold", 2.0), ("line", 1.0), ("circle", 1.0)), course_share=(0.05, 0.4),
        calm_s=45.0,
        faults={"dead": 1.0, "late": 0.9, "cut": 0.4}, delay_ms=(200, 400), loss=(10.0, 35.0),
        cut_s=(2.0, 20.0), cut_ends=1.0, cut_for_s=(3.0, 8.0), dies_s=(2.0, 9.0), dead=(1, 3),
        dead_both=0.7,
        dead_stay=1.0,
    ),
    "rovers": Preset(
        weight=0.8, summary="vehicles that roll on while their bridges or computers are gone",
        robots=(2, 6), rates_hz=((20, 1.0),), safe_m=(1.0, 1.0), speed_mps=(0.6, 0.9),
        acceleration=(0.8, 0.8),
        reach_m=(0.4, 0.4), shapes=(("lattice", 1.0),), spacing_m=(((2.6, 3.2), 1.0),),
        starts=(("near", 1.0),),
        scatter_m=5.0, apart_m=2.0, courses=(("line", 1.0),), course_share=(0.0, 0.4), hold=0.0,
        faults={"rolling": 1.0},
        quiet_s=((6.0, 1.0),), calm_s=0.0,
        tables={
            "datum": {"latitude_deg": -35.363261, "longitude_deg": 149.16523, "altitude_m": 584.0},
            "control": {"kp": 1.0, "c1": 0.6, "c2": 1.0, "kd": 1.8, "k2": 5.0, "plant_timeout_s": 0.5,
                        "wrench_timeout_s": 0.25},
            "robot_defaults": {"plant": "mavlink", "mass_kg": 20.0, "inertia_kgm2": 1.2, "mavlink": _ROVER},
        },
    ),
}  # fmt: skip
