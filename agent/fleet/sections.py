"""The tables of a fleet file but for faults: their fields, units, ranges and what is said of them (PURE).

Lengths in m, times in s, angles in rad; frame W (ENU: x east, y north, heading counter-clockwise from x).
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from handfast.agent.common import plugins
from handfast.agent.common.quantities import FAR_M, Vector
from handfast.agent.common.settings import Sectioned, Sections, T, about, setting
from handfast.agent.common.wording import show
from handfast.agent.fleet import plants
from handfast.agent.fleet.plants import SIMULATOR, MavlinkSection

SEND_PERIODS: Final = 12
"""Maximum number of periods between two hand states of a robot that sends them at events."""
SEND_BOUND_M: Final = 0.005
"""Error of the neighbours' prediction half a second ahead at which a robot sends a hand state, m."""
CLOCK_SKEW_MAX_S: Final = 0.05
"""Clock offset of a neighbour above which it is warned of, s."""
SEND_ALONE_S: Final = 0.55
"""No longer than this where beacons are seldom, too: a robot whose agent hangs is known by its silence."""

Coupling = Literal["edge", "joint", "penalty"]

LAWS: Final[Mapping[str, Mapping[str, Mapping[str, object]]]] = {
    "paper": {
        "control": {"coupling": "edge", "kp": 0.0},
        "avoidance": {"enabled": False},
    },
    "edge": {"control": {"coupling": "edge", "kp": 1.0}},
    "joint": {"control": {"coupling": "joint", "kp": 1.0}},
    "penalty": {"control": {"coupling": "penalty", "kp": 1.0}},
}
"""What ``--law NAME`` sets, by table."""

REPLACED: Final[Mapping[str, str]] = {
    "network.admission": "docs/firewall.md has rules for nftables that do the same",
    "network.budget": "`check` always says what messages take of a radio; faults.rate limits links",
    "network.budget_queue_s": 'faults.rate = "100kbit limit 50" bounds the queue of a link',
    "faults.replay": "write [[faults.rule]] with the same faults.seed: the same seed gives the same fates",
    "faults.trace": 'write a distribution: delay = "pareto 80ms 20ms"',
    "network.emulate_budget": "faults.rate limits links",
    "control.clock_skew_max_s": "clocks that are off by more than 50 ms are warned of",
    "control.relaxation": "it is 0.001 with `--law paper`, else 0.2",
    "control.send_bound_m": 'with send = "event" it is 5 mm',
    "control.send_every_s": 'with send = "event" it is twelve periods at most',
    "avoidance.beacon_hz": "it is 5 Hz; avoidance.beacon_interval_max_s makes beacons fewer",
    "avoidance.sensing_m": "it follows from the distance in which robots brake",
    "supervision.slow_after_s": "it is three quarters of control.prediction_horizon_s",
    "process": "systemd or chrt gives processes real time (docs/operating.md#real-time)",
    "robot.mavlink.own_component": "the bridge is component 191",
    "robot.mavlink.own_system": "the bridge speaks as the vehicle's own system",
    "robot.mavlink.resume_after_s": "it is 3 s",
    "robot.mavlink.set_origin": "a vehicle without an origin is given the datum",
    "faults.distribution": 'it stands in delay: "normal 80ms 20ms"',
    "faults.jitter": 'it stands in delay: "80ms 20ms"',
    "faults.rule.distribution": 'it stands in delay: "normal 80ms 20ms"',
    "faults.rule.jitter": 'it stands in delay: "80ms 20ms"',
    "faults.rule.dropout": 'write topic = "state" and loss = "10%"',
    "faults.rule.heading_noise_rad": "robot.heading_noise_rad gives a robot's sensors noise",
    "faults.rule.position_noise_m": "robot.position_noise_m gives a robot's sensors noise",
    "faults.rule.speed_noise_mps": "position_noise_m and heading_noise_rad give a robot's sensors noise",
    "faults.rule.yaw_rate_noise_radps": "position_noise_m and heading_noise_rad give a robot's sensors noise",
    "robot.speed_noise_mps": "position_noise_m and heading_noise_rad give a robot's sensors noise",
    "robot.yaw_rate_noise_radps": "position_noise_m and heading_noise_rad give a robot's sensors noise",
    "faults.rule.speed_bias_mps": "position_bias_m and heading_bias_rad put measurements off",
    "faults.rule.yaw_rate_bias_radps": "position_bias_m and heading_bias_rad put measurements off",
    "faults.rule.tick_jitter_share": 'it stands in tick_jitter: "500ms 5%"',
    "faults.rule.clock_drift": 'it stands in clock_skew: "0ms 50ppm"',
    "order.reason": "write it into a comment",
    "host.port": "give it in ~/.ssh/config, under the host's NAME",
    "host.key": "give it in ~/.ssh/config, under the host's NAME",
    "host.python": "the first Python of 3.11 or later on its PATH is taken",
    "recording.enabled": "recording.max_mb = 0 records nothing",
    "avoidance.barrier_rate": "it follows from control.max_acceleration, max_speed_mps and fleet.rate_hz",
    "geofence.warn_m": "it is 0.5 m",
    "faults.limit": 'it stands in rate: "100kbit limit 50"',
    "faults.rule.limit": 'it stands in rate: "100kbit limit 50"',
    "faults.slot": "rate and delay make messages late",
    "faults.rule.slot": "rate and delay make messages late",
    "faults.hold": "loss or a partition silences a link; pause holds a process",
    "faults.rule.hold": "loss or a partition silences a link; pause holds a process",
    "faults.rule.jump_probability": "one measurement in a hundred jumps",
}
"""Fields of former versions, and what replaced each. `robot` stands for `robot_defaults` as well."""

LAWS_GROUP: Final = "handfast.laws"
"""Group of entry points that are laws of others."""

TRAJECTORY_FIELDS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "hold": ((), ("start_m",)),
    "line": (("velocity_mps",), ("start_m",)),
    "circle": (("centre_m", "radius_m", "speed_mps"), ("phase_rad", "clockwise")),
    "waypoints": (("waypoints_m", "speed_mps"), ("corner_acceleration",)),
}
"""Fields that each kind of trajectory needs, and those that it takes besides; others are errors with it."""


def load_law(reference: str) -> type[Any]:
    """The class of a law of others.

    Raises:
        handfast.agent.common.plugins.PluginError: there is none.
    """
    try:
        return plugins.load(reference, LAWS_GROUP, "handfast.agent.control.own_law:Law", LAWS)
    except plugins.PluginError as error:
        if ":" in reference:
            raise
        wrong = f"must be one of {', '.join(LAWS)}, or a plugin, got {show(reference)}: {error}"
        raise plugins.PluginError(wrong) from None


@dataclass(frozen=True, slots=True)
class FleetSection:
    """``[fleet]``: name, rate, duration and seed of a run."""

    name: str = field(
        metadata=about(
            "The fleet's name: the first segment of every key on the bus, and in the name of a run's folder.",
            pattern=r"[A-Za-z0-9_-]{1,40}",
            pattern_says="1 to 40 letters, digits, - or _",
            example='"delta"',
        )
    )
    rate_hz: float = setting(50.0, "How often every agent runs its control law.", unit="Hz", ge=1, le=1000)
    duration_s: float = setting(30.0, "How long a run drives, from the common start.", unit="s", gt=0, le=1e6)
    seed: int = setting(
        0, "Seed of everything random: noise, link faults. Same seed, same run.", ge=0, le=2**63 - 1
    )
    description: str = setting(
        "",
        "A sentence for people; nothing depends on it.",
        lines=True,
        example='"Six robots in a triangle"',
    )


@dataclass(frozen=True, slots=True)
class FormationSection:
    """``[formation]``: places, edges and their distances."""

    edges: tuple[tuple[int, int], ...] = field(
        metadata=about(
            "The formation graph: pairs of robot ids that keep their distance and talk to each other.",
            example="[[1, 2], [2, 3]]",
        )
    )
    safe_distance_m: float = field(
        metadata=about(
            "r_s: two robots of an edge never come this close. Below the distance of every edge.",
            unit="m",
            gt=0,
            le=FAR_M,
            example="0.22",
        )
    )
    offsets: tuple[Vector, ...] | None = setting(
        None,
        "Where each robot stands relative to the trajectory, one pair per `[[robot]]` in their order, those "
        "in reserve left out. "
        "This or `distance_m` must be given.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
        example="[[0.0, 0.5], [0.0, -0.5]]",
    )
    distance_m: float | tuple[float, ...] | None = setting(
        None,
        "Desired distance of every edge, or an array with one per edge. Left out: taken from `offsets`.",
        unit="m",
        gt=0,
        le=FAR_M,
        example="1.0",
    )
    assign: bool = setting(
        False,
        "Robots take the places by least total squared distance from their starts, not in their order. "
        "Edges belong to the places: they then join the robots that took them.",
    )


@dataclass(frozen=True, slots=True)
class ControlSection(Sectioned):
    """``[control]``: gains, limits and timeouts of the control law."""

    coupling: Coupling = setting(
        "joint",
        "How multipliers are found: `edge` by edge (the paper's), `joint` with those of the edges around, "
        "or `penalty`: a potential field, no multipliers.",
    )
    c1: float = setting(0.4, "Navigation: gain on the position error.", unit="1/s2", gt=0, le=1e4)
    c2: float = setting(0.6, "Navigation: gain on the velocity error.", unit="1/s", gt=0, le=1e4)
    kd: float = setting(1.8, "Damping of an edge's constraint.", unit="1/s", ge=0, le=1e4)
    k2: float | None = setting(
        None,
        "Softness of an edge's constraint. Left out: for each edge by its scale, 4 / (d - r_s)^2, so that "
        "formations of any size behave alike; more where `max_speed_mps` limits the pull to far places.",
        unit="1/m2",
        gt=0,
        le=1e6,
        example="5.0",
    )
    kp: float = setting(
        1.0, "Stiffness of an edge's constraint; 0 is the paper's law.", unit="1/s2", ge=0, le=1e4
    )
    max_acceleration: float = setting(
        5.0,
        "Largest commanded acceleration of the hand point. With `avoidance.enabled` it is at most half of "
        "`max_speed_mps` in one period, which counts at low rates.",
        unit="m/s2",
        gt=0,
        le=1e3,
    )
    max_speed_mps: float = setting(
        1.5,
        "Largest speed of a hand point. It limits how fast a robot makes for its place, and the safety "
        "filter keeps it (`avoidance.enabled`). At most `max_acceleration` c2/c1 is made use of: from more, "
        "robots brake and turn too slowly to come to rest at their places.",
        unit="m/s",
        gt=0,
        le=100,
    )
    prediction: bool = setting(
        True,
        "Carries a neighbour's state forward over the age of its message; false: the law takes it as it "
        "came, and only what keeps robots apart carries it forward.",
    )
    prediction_horizon_s: float = setting(
        2.0,
        "A neighbour's last state is carried forward this long at most; one that is silent for longer is "
        "given up (`supervision.silence`). At least two periods.",
        unit="s",
        gt=0,
        le=60,
    )
    send: Literal["periodic", "event"] = setting(
        "periodic",
        "When hand states are sent: in every period, or at an `event`: when neighbours cannot know by "
        "themselves what has become of the last one (docs/theory.md, E1), and at least every twelve periods.",
    )
    plant_timeout_s: float = setting(
        0.2, "An agent whose plant is silent for so long stops. At least two periods.", unit="s", gt=0, le=60
    )
    wrench_timeout_s: float = setting(
        0.2, "A plant whose agent is silent for so long brakes. At least two periods.", unit="s", gt=0, le=60
    )
    rate_min_hz: float | None = setting(
        None,
        "Robots whose machine cannot keep `fleet.rate_hz` decide more rarely, all of the fleet together and "
        "by halves of the rate, down to this one; `fleet.rate_hz` itself: never. The safety filter's "
        "rate is then one that this one carries. Left out: as far as law, safety filter and timeouts "
        "carry it as they are.",
        unit="Hz",
        ge=1,
        le=1000,
        example="5.0",
    )
    law: str | None = setting(
        None,
        "The law. A plugin stands in the place of the constraint force and its `coupling`: its class, "
        "`package.module:Class`, or its name (docs/plugins.md). The names that `--law` knows set what they "
        "set there, so that a sweep over this field compares laws; left out: `coupling` and the gains.",
        example='"my_package.my_module:MyLaw"',
    )
    sections: Sections = setting((), "Tables of laws.", sections=tuple)

    @property
    def relaxation(self) -> float:
        """Share of the way from the safe distance to the wanted one below which the constraint goes on along
        its tangent, instead of to its pole at the safe distance. The paper's law hardly does."""
        return 0.001 if self.coupling == "edge" and self.kp == 0.0 else 0.2


@dataclass(frozen=True, slots=True)
class TrajectorySection:
    """``[trajectory]``: fields that its kind does not use keep their defaults."""

    kind: Literal["line", "waypoints", "circle", "hold"] = setting(
        "hold", "What the formation's reference point does. Fields of other kinds are errors."
    )
    start_m: Vector = setting(
        (0.0, 0.0),
        "`line`: where the reference is at the start; `hold`: where it stays.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
    )
    velocity_mps: Vector | None = setting(
        None, "`line`: constant velocity.", unit="m/s", ge=-100, le=100, example="[0.2, 0.2]"
    )
    waypoints_m: tuple[Vector, ...] | None = setting(
        None,
        "`waypoints`: at least two points, driven in order; the first is the start, the last is held.",
        unit="m",
        ge=-FAR_M,
        le=FAR_M,
        example="[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]",
    )
    speed_mps: float | None = setting(
        None, "`waypoints`, `circle`: speed of the reference.", unit="m/s", gt=0, le=100, example="0.3"
    )
    corner_acceleration: float = setting(
        0.3, "`waypoints`: acceleration with which corners are rounded.", unit="m/s2", gt=0, le=100
    )
    centre_m: Vector | None = setting(
        None, "`circle`: its centre.", unit="m", ge=-FAR_M, le=FAR_M, example="[0.0, 0.0]"
    )
    radius_m: float | None = setting(None, "`circle`: its radius.", unit="m", gt=0, le=FAR_M, example="3.0")
    phase_rad: float = setting(
        0.0,
        "`circle`: angle of the start, seen from the centre.",
        unit="rad",
        ge=-math.tau,
        le=math.tau,
        example='"90deg"',
    )
    clockwise: bool = setting(False, "`circle`: the way round.")


@dataclass(frozen=True, slots=True)
class DatumSection:
    """``[datum]``: where the origin of W lies on the earth."""

    latitude_deg: float = field(
        metadata=about("Latitude, WGS 84.", unit="deg", ge=-85, le=85, example="-35.363261")
    )
    longitude_deg: float = field(
        metadata=about("Longitude, WGS 84.", unit="deg", ge=-180, le=180, example="149.165230")
    )
    altitude_m: float = setting(0.0, "Height of the ground above mean sea level.", unit="m", ge=-500, le=9000)


@dataclass(frozen=True, slots=True)
class Body(Sectioned):
    """``[robot_defaults]``: what drives, and how it is measured."""

    mass_kg: float = setting(10.0, "Mass m.", unit="kg", gt=0, le=1e5)
    inertia_kgm2: float = setting(
        0.13, "Moment of inertia J about the vertical axis.", unit="kg m2", gt=0, le=1e5
    )
    hand_offset_m: float = setting(
        0.1,
        "L: the hand point, which is what is controlled, lies so far ahead of the axle.",
        unit="m",
        gt=0,
        le=100,
    )
    plant: str = setting(
        plants.DEFAULT,
        "What drives: "
        + ", ".join(f"`{kind.name}` {kind.says}" for kind in plants.KINDS.values())
        + ". Or a plugin: its class, `package.module:Class`, or its name (docs/plugins.md).",
    )
    max_force_n: float | None = setting(
        None, "Largest driving force; left out: no limit.", unit="N", gt=0, le=1e6, example="50.0"
    )
    max_torque_nm: float | None = setting(
        None, "Largest turning torque; left out: no limit.", unit="N m", gt=0, le=1e6, example="5.0"
    )
    actuator_lag_s: float = setting(
        0.0, "Time constant between commanded and real force and torque.", unit="s", ge=0, le=10
    )
    position_noise_m: float = setting(
        0.0, "Standard deviation of measured positions.", unit="m", ge=0, le=100
    )
    heading_noise_rad: float = setting(
        0.0, "Standard deviation of the measured heading.", unit="rad", ge=0, le=math.pi
    )
    host: str | None = setting(
        None,
        "Name of the `[host.NAME]` on which its processes run. All robots have one, or none has. Not part "
        "of the digest.",
        example='"rover1"',
    )
    sections: Sections = setting((), "Tables of kinds of plant.", sections=plants.built_in_sections)

    @property
    def kind(self) -> plants.Kind:
        """What its `plant` is. A plugin that is not here, as in a recording from elsewhere, is no vehicle."""
        try:
            return plants.kind(self.plant)
        except plugins.PluginError:
            return plants.Kind(self.plant)

    @property
    def yaw_rate_max(self) -> float:
        """How fast its body turns at most, rad/s; inf where its plant sets no limit."""
        kind = self.kind
        table = self.section(kind.section.hint) if kind.turns and kind.section is not None else None
        return math.inf if table is None else float(getattr(table, kind.turns))

    def section(self, model: type[T]) -> T | None:
        """The table of this model, None where the robot's plant has no such table or it is not given."""
        own = self.kind.section
        return Sectioned.section(self, model) if own is not None and own.hint is model else None


@dataclass(frozen=True, slots=True)
class Robot(Body):
    """One ``[[robot]]``."""

    # The file must give these; the defaults here only let them follow Body's.
    id: int = setting(0, "The robot's number, which `edges` use.", ge=1, le=9999, required=True)
    x_m: float = setting(
        0.0, "Where its centre starts, east.", unit="m", ge=-FAR_M, le=FAR_M, required=True, example="-1.0"
    )
    y_m: float = setting(
        0.0, "Where its centre starts, north.", unit="m", ge=-FAR_M, le=FAR_M, required=True, example="1.4"
    )
    heading_rad: float = setting(
        0.0,
        "Where it looks at the start, counter-clockwise from east.",
        unit="rad",
        ge=-math.tau,
        le=math.tau,
        example='"90deg"',
    )
    reserve: bool = setting(
        False,
        "It is there but has no place in the formation until it joins (`[[order]]`, `handfast change join`).",
    )

    @property
    def is_simulated(self) -> bool:
        """Whether its body is a vehicle that has to be simulated."""
        link = self.section(MavlinkSection)
        return link is not None and link.connection == SIMULATOR
