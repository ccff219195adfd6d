"""What `handfast check` finds, and that its linear algebra is the law's."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import (
    ControlSection,
    FleetSection,
    FormationSection,
    Robot,
    TrajectorySection,
)
from handfast.agent.formation.geometry import resolve, start_hands
from handfast.deploy.analysis import fleet_law
from handfast.deploy.analysis.couplings import COUPLINGS, coupling_of
from handfast.deploy.analysis.stability import settling_time
from handfast.deploy.check.check import Finding, check

H = sqrt(3.0) / 2.0
EDGES = ((1, 2), (1, 3), (2, 3), (2, 4), (2, 5), (3, 5), (3, 6), (4, 5), (5, 6))
OFFSETS = ((0.0, -2 * H), (-0.5, -H), (0.5, -H), (-1.0, 0.0), (0.0, 0.0), (1.0, 0.0))
STARTS = ((-1.0, 1.4), (-0.7, -0.9), (-0.2, 0.3), (1.0, 2.0), (0.1, 1.0), (-0.18, 0.0))  # the paper's
SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
WAYPOINTS = TrajectorySection(
    "waypoints", waypoints_m=((0.0, 0.0), (4.0, 0.0), (4.0, 3.0)), speed_mps=0.5, corner_acceleration=0.3
)
CIRCLE = TrajectorySection("circle", centre_m=(0.0, 0.0), radius_m=2.0, speed_mps=0.4)


def fleet(
    starts=STARTS, edges=EDGES, offsets=OFFSETS, trajectory=None, control=None, body=None, **fields
) -> Fleet:
    """The delta from the paper's starts, or other starts, edges and offsets."""
    return Fleet(
        FleetSection("test", **{key: fields.pop(key) for key in ("rate_hz", "duration_s") if key in fields}),
        FormationSection(
            edges=edges, safe_distance_m=fields.pop("safe_distance_m", 0.22), offsets=offsets, **fields
        ),
        ControlSection(**(control or {})),
        trajectory or TrajectorySection("line", velocity_mps=(0.2, 0.2)),
        tuple(Robot(id=k, x_m=x, y_m=y, **(body or {})) for k, (x, y) in enumerate(starts, 1)),
    )


def lattice(rows: int, **control) -> Fleet:
    """A triangle of robots 1 m apart, `rows` in its last row, started 1.3 times as large."""
    places = [(column - row / 2, row * H) for row in range(rows) for column in range(row + 1)]
    edges = [
        (i + 1, j + 1)
        for j, b in enumerate(places)
        for i, a in enumerate(places[:j])
        if abs(np.hypot(a[0] - b[0], a[1] - b[1]) - 1.0) < 1e-6
    ]
    starts = tuple((1.3 * x, 1.3 * y) for x, y in places)
    return fleet(starts, tuple(edges), tuple(places), TrajectorySection(), control)


def at(findings: list[Finding], place: str, level: str) -> str:
    """Message of the one finding at `place`, which must have this level."""
    found = [finding for finding in findings if finding.place == place]
    assert [finding.level for finding in found] == [level], findings
    return found[0].message


def levels(findings: list[Finding]) -> list[str]:
    return [finding.level for finding in findings]


# --- a sound fleet ---


def test_the_delta_with_the_joint_law_has_nothing_to_report():
    assert check(fleet()) == []
    assert check(fleet(assign=True, distance_m=1.0)) == []
    assert check(fleet(offsets=None, distance_m=1.0, assign=True)) == []


def test_findings_come_at_once_errors_first():
    findings = check(
        fleet(
            distance_m=1.5,
            edges=EDGES[:-1],
            control={"kp": 9.0, "coupling": "edge"},
            body={"position_noise_m": 0.01, "actuator_lag_s": 0.1},
        )
    )
    assert levels(findings) == sorted(levels(findings), key=["error", "warning", "info"].index)
    assert {finding.level for finding in findings} == {"error", "warning", "info"}
    assert levels(findings).count("error") == 8


# --- formation ---


def test_distances_that_contradict_offsets_are_listed_edge_by_edge():
    each = (1.0,) * 8 + (1.02,)
    message = at(check(fleet(distance_m=each)), "formation.distance_m[9]", "error")
    assert "[5, 6] is to be 1.02 m long" in message
    assert "1 m apart" in message
    assert check(fleet(distance_m=(1.0,) * 8 + (1.009,))) == []


def test_a_graph_in_parts_lists_them():
    message = at(check(fleet(edges=((1, 2), (2, 3), (1, 3), (4, 5), (5, 6)))), "formation.edges", "info")
    assert "{1, 2, 3}, {4, 5, 6}" in message


def test_a_shape_that_can_shift_says_which_robots():
    message = at(check(fleet(SQUARE, ((1, 2), (2, 3), (3, 4), (4, 1)), SQUARE)), "formation.edges", "warning")
    assert "robots 3 and 4 can shift" in message
    assert "rank 4 of 5" in message
    assert "1 more edge " in message


def test_a_line_of_robots_says_that_no_edges_make_it_rigid():
    line = ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    message = at(check(fleet(line, ((1, 2), (2, 3), (1, 3)), line)), "formation.edges", "warning")
    assert "in one line" in message
    assert "robot 2" in message or "robot 3" in message


def test_distances_that_no_plane_has_are_an_error_with_the_residual():
    all_pairs = tuple((a, b) for b in range(1, 5) for a in range(1, b))
    message = at(check(fleet(SQUARE, all_pairs, None, distance_m=1.0)), "formation.distance_m", "error")
    assert "instead of 1 m" in message


def test_a_safe_distance_near_or_above_an_edge():
    close = {"starts": tuple((3 * x, 3 * y) for x, y in OFFSETS), "trajectory": TrajectorySection()}
    assert "85% of" in at(check(fleet(**close, safe_distance_m=0.85)), "formation.safe_distance_m", "warning")
    message = at(check(fleet(**close, safe_distance_m=1.0)), "formation.safe_distance_m", "error")
    assert "1 m, but edge" in message
    assert "below 0.8 m" in message


def test_places_too_close_without_an_edge_are_an_error():
    offsets = (*OFFSETS[:5], (-0.9, 0.1))  # robot 6 next to robot 4
    findings = check(fleet(offsets=offsets, edges=(*EDGES[:-1], (5, 6))))
    assert "robots 4 and 6 share no edge and their places are 0.141 m apart" in at(
        findings, "formation.offsets", "error"
    )


# --- starts ---


def test_the_edges_are_those_of_the_robots_that_took_the_slots():
    # Robots 1 and 4 start nearer to each other's slots; [3, 4] is no edge of the file, [1, 3] is.
    starts = [OFFSETS[k] for k in (3, 1, 2, 0, 4, 5)]
    starts[3] = (0.4, -1.0)  # robot 4 takes slot 1; robot 3 is at (0.5, -H)
    given = fleet(tuple(starts), trajectory=TrajectorySection(), assign=True)
    assert resolve(given).offsets[3].tolist() == list(OFFSETS[0])
    message = at(check(given), "robot[4]", "error")
    assert "robots 3 and 4" in message
    assert "share an edge" in message


def test_robots_without_an_edge_that_start_close_are_a_warning():
    starts = (*STARTS[:5], (-0.65, -0.8))  # robot 6, next to robot 2
    message = at(check(fleet(starts)), "robot[6]", "warning")
    assert "robots 2 and 6" in message
    assert "share no edge" in message


def bare(given: Fleet) -> Fleet:
    """Without avoidance: no limit of speed, nor any cut of the pull (N1)."""
    return replace(given, avoidance=replace(given.avoidance, enabled=False))


# --- law ---


def control_of(coupling: str) -> ControlSection:
    return ControlSection(coupling=coupling, c1=0.4, c2=0.7, kd=1.8, k2=5.0, kp=0.9)  # type: ignore[arg-type]


@pytest.mark.parametrize("coupling", ["joint", "edge", "penalty"])
def test_modes_are_those_of_the_law_itself(coupling: str):
    """Differences of `agent.control.law` about the formation give the same gains as `modes`."""
    given = lattice(3)
    control, geometry = control_of(coupling), resolve(given)
    n, step = len(geometry.ids), 1e-5

    def force(error, rate):
        return commanded(geometry, control, error, rate)

    def differences(which: int):
        columns = []
        for k in range(2 * n):
            shift = np.zeros(2 * n)
            shift[k] = step
            shift = shift.reshape(n, 2).T
            zero = np.zeros((2, n))
            plus, minus = (
                force(*((sign * shift, zero) if which == 0 else (zero, sign * shift))) for sign in (1.0, -1.0)
            )
            columns.append(((plus - minus) / (2 * step)).T.ravel())
        return -np.array(columns).T

    stiffness, damping = differences(0), differences(1)
    found = COUPLINGS[coupling](replace(given, control=control)).modes(geometry)
    assert len(found) == 2 * n
    assert np.sort(np.linalg.eigvals(stiffness).real) == pytest.approx(
        sorted(mode.k1 for mode in found), abs=1e-5
    )
    assert np.sort(np.linalg.eigvals(damping).real) == pytest.approx(
        sorted(mode.k2 for mode in found), abs=1e-5
    )
    assert sum(mode.shape for mode in found) == 9


def commanded(geometry, control, error, rate, multipliers=None):
    """u of all robots by `agent.control.law`, (2, n); with `multipliers`, by one sweep, and those after
    it."""
    coupling = coupling_of(replace(lattice(3), control=control))
    assert coupling is not None
    i, j = geometry.edges.T
    n = len(geometry.ids)
    position = error + geometry.offsets.T
    navigation = fleet_law.navigation_force(0.0, error, rate, control.c1, control.c2)
    edges = fleet_law.edges(
        position[:, i] - position[:, j],
        rate[:, i] - rate[:, j],
        navigation[:, i] - navigation[:, j],
        geometry.distances,
        0.22,
        coupling.gains,
    )
    if multipliers is not None:
        total = fleet_law.total_forces(fleet_law.forces(edges, multipliers), i, j, n)
        degree = np.bincount(geometry.edges.ravel(), minlength=n)
        new = fleet_law.multipliers_sweep(
            edges, multipliers, total[:, i] - total[:, j], degree[i] + degree[j]
        )
        return navigation + fleet_law.total_forces(fleet_law.forces(edges, new), i, j, n), new
    new = coupling.multipliers(edges, i, j, n)
    return navigation + fleet_law.total_forces(fleet_law.forces(edges, new), i, j, n)


@pytest.mark.parametrize(("kd", "stable"), [(1.8, True), (15.0, True), (500.0, False)])
def test_sweep_radius_says_how_the_sampled_law_grows(kd: float, stable: bool):
    """The law run with sweeps from a small error grows or falls as the largest eigenvalue says."""
    given, rate_hz = lattice(3), 50.0
    geometry = resolve(given)
    control = replace(given.control, kd=kd)
    radius = COUPLINGS["joint"](replace(given, control=control)).sweep_radius(geometry, rate_hz)
    assert (radius < 1.0) == stable
    h, n = 1.0 / rate_hz, len(geometry.ids)
    generator = np.random.default_rng(5)
    error, speed = (1e-5 if stable else 1e-9) * generator.normal(size=(2, n)), np.zeros((2, n))
    multipliers, u = np.zeros(len(geometry.edges)), np.zeros((2, n))
    sizes = []
    ticks = 1800 if stable else 15
    for _ in range(ticks):
        # (P2): the law sees the middle of its period, as the last force would bring it there.
        seen = error + 0.5 * h * speed + 0.125 * h * h * u, speed + 0.5 * h * u
        u, multipliers = commanded(geometry, control, *seen, multipliers)
        error, speed = error + h * speed + 0.5 * h * h * u, speed + h * u
        sizes.append(np.sqrt(np.sum(error**2) + np.sum(speed**2)))
    slope = np.log(sizes[-1] / sizes[ticks // 2]) / (ticks - 1 - ticks // 2)
    assert slope == pytest.approx(np.log(radius), rel=0.1)


@pytest.mark.parametrize(("kd", "level"), [(10.0, None), (40.0, "warning"), (200.0, "error")])
def test_a_rate_too_slow_for_the_gains(kd: float, level: str | None):
    findings = check(fleet(control={"kd": kd, "c2": 0.6}, duration_s=1e4))
    if level is None:
        assert findings == []
        return
    message = at(findings, "fleet.rate_hz", level)
    assert message.startswith("50 Hz")
    needed = float(message.split("at least ")[1].split(" Hz")[0])
    assert check(fleet(control={"kd": kd}, rate_hz=needed * 1.05, duration_s=1e4)) == [] or level == "error"
    assert "error" not in levels(check(fleet(control={"kd": kd}, rate_hz=needed * 1.05, duration_s=1e4)))


def test_the_papers_law_is_unstable_on_large_lattices_only():
    paper = {"coupling": "edge", "kp": 0.0, "k2": 5.0}
    assert "error" not in levels(check(fleet(control=paper)))
    assert "error" not in levels(check(lattice(5, **paper)))
    findings = check(lattice(9, **paper))
    assert findings[0].level == "error"
    assert "unstable at the formation itself" in findings[0].message
    assert check(lattice(9)) == []


@pytest.mark.parametrize(("kp", "level"), [(0.0, "info"), (1.6, None), (1.8, "warning")])
def test_kp_too_low_or_too_high(kp: float, level: str | None):
    findings = [finding for finding in check(fleet(control={"kp": kp})) if finding.place == "control.kp"]
    assert levels(findings) == ([level] if level else [])


def test_an_actuator_lag_that_a_mode_cannot_bear():
    assert "unstable from" in at(
        check(fleet(body={"actuator_lag_s": 1.0})), "robot[1].actuator_lag_s", "warning"
    )
    at(check(fleet(body={"actuator_lag_s": 3.0})), "robot[1].actuator_lag_s", "error")
    assert [each.place for each in check(fleet(body={"actuator_lag_s": 0.1}))] == ["avoidance.margin_m"]


@pytest.mark.parametrize("kd", [1.8, 12.0])
def test_the_settling_estimate_is_that_of_the_law_for_two_robots(kd: float):
    """Two robots, apart along their edge: the law itself, run in small steps, settles when estimated."""
    two, edge, places = ((-0.85, 0.0), (0.65, 0.0)), ((1, 2),), ((-0.5, 0.0), (0.5, 0.0))
    given = fleet(two, edge, places, TrajectorySection(), {"kd": kd})
    geometry = resolve(given)
    estimate = settling_time(given, geometry, COUPLINGS["joint"](given))
    assert estimate is not None
    error = (start_hands(given) - geometry.offsets).T
    speed, h, last = np.zeros((2, 2)), 0.005, 0.0
    for k in range(8000):
        u = commanded(geometry, given.control, error, speed)
        speed = speed + h * u
        error = error + h * speed
        if abs(1.0 + error[0, 1] - error[0, 0] - 1.0) > 0.05:
            last = h * (k + 1)
    assert 0.5 * last < estimate < 2.0 * last
    assert "may end before" in at(
        check(replace(given, fleet=FleetSection("test", duration_s=0.5 * estimate))),
        "fleet.duration_s",
        "info",
    )


# --- trajectory and bodies ---


def test_a_circle_too_fast_for_the_acceleration_limit():
    quick = replace(CIRCLE, radius_m=0.6, speed_mps=1.4)  # 3.27 m/s2
    fast = {"max_speed_mps": 4.0}
    given = fleet(trajectory=quick, control=fast, body={"hand_offset_m": 0.5})
    assert [each.level for each in check(given) if "65% of control.max_acceleration" in each.message] == [
        "warning"
    ]
    too_quick = replace(CIRCLE, radius_m=0.6, speed_mps=1.8)  # 5.4 m/s2
    given = fleet(trajectory=too_quick, control=fast, body={"hand_offset_m": 0.5})
    (message,) = [each.message for each in check(given) if each.level == "error"]
    assert "take speed_mps = 1.73 or less" in message


@pytest.mark.parametrize(
    ("speed", "level", "words"),
    [
        (1.2, None, ""),
        (1.4, "warning", "leaves 0.1 m/s of control.max_speed_mps = 1.5 to catch up with"),
        (1.5, "warning", "who is behind its place stays behind"),
        (3.0, "error", "fall behind, by 1.5 m in every second; take at most 1.35 m/s"),
    ],
)
def test_a_trajectory_faster_than_the_robots(speed: float, level: str | None, words: str):
    for kind in (
        TrajectorySection("line", velocity_mps=(0.6 * speed, -0.8 * speed)),
        replace(WAYPOINTS, waypoints_m=((0.0, 0.0), (90.0, 0.0)), speed_mps=speed),
        replace(CIRCLE, radius_m=9.0, speed_mps=speed),
    ):
        given = fleet(trajectory=kind)
        found = [each for each in check(given) if "control.max_speed_mps" in each.message]
        assert levels(found) == ([level] if level else [])
        assert all(words in each.message for each in found)
        assert not [each for each in check(bare(given)) if "control.max_speed_mps" in each.message]


def test_a_circle_that_turns_faster_than_a_body_may():
    """(F9): 0.12 rad in a period."""
    slow = fleet(trajectory=replace(CIRCLE, radius_m=0.5, speed_mps=0.4), rate_hz=5.0)
    message = at(check(slow), "trajectory.speed_mps", "error")
    assert "turns by 0.8 rad/s, and at 5 Hz a body may turn by 0.6 rad/s" in message
    assert "at most 0.27 m/s, a radius of 0.741 m, or 7.41 Hz" in message
    assert not [each for each in check(fleet(trajectory=CIRCLE, rate_hz=5.0)) if "turns" in each.message]


def test_a_run_longer_or_shorter_than_its_trajectory():
    assert "comes to rest after 16.5 s" in at(check(fleet(trajectory=WAYPOINTS)), "trajectory", "info")
    message = at(check(fleet(trajectory=WAYPOINTS, duration_s=12.0)), "trajectory", "info")
    assert "needs 16.5 s, but fleet.duration_s = 12" in message


@pytest.mark.parametrize(
    ("change", "warns"),
    [
        ({}, True),
        ({"corner_acceleration": 0.1}, False),
        ({"speed_mps": 0.2}, False),  # so slow that it may swing round while it is driven back
        ({"waypoints_m": ((0.0, 0.0), (4.0, 0.0), (0.0, 2.0))}, False),  # it is led round
    ],
)
def test_a_course_that_turns_back_sooner_than_bodies_turn_about(change: dict[str, Any], warns: bool):
    back = TrajectorySection(
        "waypoints", waypoints_m=((0.0, 0.0), (4.0, 0.0), (0.0, 0.0)), speed_mps=0.4, corner_acceleration=0.3
    )
    control = {"max_acceleration": 0.8, "max_speed_mps": 1.5}
    found = check(fleet(trajectory=replace(back, **change), control=control, body={"hand_offset_m": 0.08}))
    texts = [each.message for each in found if "turns back" in each.message]
    assert bool(texts) == warns
    if warns:
        assert texts[0].startswith("the course turns back at waypoint 2 with 0.3 m/s2: robot 1, whose hand")
        assert "take at most 0.11 m/s2" in texts[0]


@pytest.mark.parametrize(("offset", "level"), [(0.1, None), (0.03, "warning"), (0.005, "error")])
def test_a_hand_offset_too_small_for_the_speed_where_no_limit_keeps_turns_small(
    offset: float, level: str | None
):
    line = TrajectorySection("line", velocity_mps=(0.6, 0.0))
    given = fleet(trajectory=line, body={"hand_offset_m": offset})
    assert check(given) == []
    findings = check(bare(given))
    if level is None:
        assert findings == []
        return
    (finding,) = [finding for finding in findings if finding.place.endswith("hand_offset_m")]
    assert finding.level == level
    assert f"robot {finding.place[6]}'s is {offset:g} m" in finding.message


def test_bodies_too_weak_for_the_trajectory():
    findings = check(fleet(trajectory=WAYPOINTS, body={"max_force_n": 2.0}))
    assert "it takes 3 N" in at(findings, "robot[1].max_force_n", "error")
    assert "clips before the law" in at(
        check(fleet(trajectory=WAYPOINTS, body={"max_force_n": 20.0})), "robot[1].max_force_n", "info"
    )
    weak = [f for f in check(fleet(trajectory=WAYPOINTS, body={"max_torque_nm": 0.3})) if "torque" in f.place]
    assert levels(weak) == ["warning"] * 6
    assert "takes 0.39 N m" in weak[0].message
    slow_circle = replace(CIRCLE, speed_mps=1.0)  # 0.5 m/s2
    at(check(fleet(trajectory=slow_circle, body={"max_force_n": 2.0})), "robot[1].max_force_n", "warning")


# --- description ---
