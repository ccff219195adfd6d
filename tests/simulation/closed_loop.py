"""The continuous closed loop of the paper, written straight from its equations and solved by scipy.

Independent of `agent.control.law`: the constraint matrices are built as in (9)-(11) and (29)-(34), edge by
edge, with Adot rdot as a derivative along the motion worked out on paper for D = r_i - r_j.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolve
from handfast.agent.formation.trajectory import make_trajectory

Array = NDArray[np.float64]


def constraint_forces(
    r: Array, v: Array, fn: Array, edges: list[tuple[int, int]], d: list[float], fleet: Fleet
) -> Array:
    """F_c of every robot by (32)-(33), (n, 2)."""
    control, rs = fleet.control, fleet.formation.safe_distance_m
    fc = np.zeros_like(r)
    for (i, j), dij in zip(edges, d, strict=True):
        delta, rate = r[i] - r[j], v[i] - v[j]
        rho = np.sqrt(delta @ delta)
        a = (dij - rs) * delta / ((rho - rs) ** 2 * rho)  # (10)
        rho_dot = delta @ rate / rho
        # d/dt of a: (d - rs) [ rate g + delta gdot ], g = 1 / ((rho - rs)^2 rho)
        g = 1.0 / ((rho - rs) ** 2 * rho)
        g_dot = -g * rho_dot * (2.0 / (rho - rs) + 1.0 / rho)
        a_dot = (dij - rs) * (rate * g + delta * g_dot)
        phi_dot = a @ rate  # (9)
        phi = (rho - dij) / (rho - rs)  # (7)
        lam = (-a_dot @ rate - a @ (fn[i] - fn[j]) - control.kd * phi_dot - control.kp * phi) / (
            control.k2 + 2.0 * a @ a
        )  # (33)
        fc[i] += a * lam
        fc[j] -= a * lam
    return fc


def solve(fleet: Fleet, times: Array) -> Array:
    """Hand points of all robots at `times` (s), shape (len(times), n, 2), m, W.

    Robots start at rest; a piecewise trajectory's derivative may jump at t = 0 only.
    """
    geometry = resolve(fleet)
    n = len(geometry.ids)
    trajectory = make_trajectory(fleet.trajectory)
    edges = [(int(i), int(j)) for i, j in geometry.edges]
    d = [float(x) for x in geometry.distances]
    c1, c2 = fleet.control.c1, fleet.control.c2

    def rate(t: float, y: Array) -> Array:
        r, v = y[: 2 * n].reshape(n, 2), y[2 * n :].reshape(n, 2)
        x, y_, vx, vy, ax, ay = trajectory.at(t)
        e = r - geometry.offsets - (x, y_)
        fn = np.array((ax, ay)) - c1 * e - c2 * (v - (vx, vy))  # (21)
        fc = constraint_forces(r, v, fn, edges, d, fleet)
        return np.concatenate([v.ravel(), (fn + fc).ravel()])

    start = np.array(
        [
            (
                robot.x_m + robot.hand_offset_m * np.cos(robot.heading_rad),
                robot.y_m + robot.hand_offset_m * np.sin(robot.heading_rad),
            )
            for robot in fleet.members
        ]
    )
    state = np.concatenate([start.ravel(), np.zeros(2 * n)])
    out = [start]
    for begin, end in pairwise(times):
        solution = solve_ivp(rate, (begin, end), state, method="DOP853", rtol=1e-10, atol=1e-12)
        state = solution.y[:, -1]
        out.append(state[: 2 * n].reshape(n, 2))
    return np.array(out)
