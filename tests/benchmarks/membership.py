"""Join, leave and reshaping of the delta while it drives: how far the commands jump from tick to tick.

The bundled fleet `reserve` in virtual time, with the orders of docs/orders. Besides,
``python -m tests.benchmarks.membership DIR`` draws the figures of docs/membership.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import hypot
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Picture

from agent.common.time import NS_PER_S
from agent.control import hand
from agent.control.hand import Pose
from agent.fleet.loading import load_fleet
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve, resolved
from agent.formation.points import Floats
from agent.messages.codec import decode
from deploy.analysis.analysis import Analysis, analyse
from deploy.console.arguments import fleet_path
from deploy.recording.collector import RunData
from deploy.recording.recording import Recording
from deploy.report.drawing.plotting import DOTTED, GREY, INK, PALETTE, new_figure, nth_color, write
from deploy.simulate.simulation import Simulation
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.hand_acceleration import hand_acceleration

ORDERS: Final = Path(__file__).parents[2] / "docs" / "orders"
WINDOWS_S: Final = {"join": (12.0, 34.0), "leave": (12.0, 24.0), "reshape": (12.0, 44.0)}
"""Of fleet time: what is drawn, and looked at for jumps."""


@dataclass(frozen=True)
class Drive:
    """One drive with its orders."""

    fleet: Fleet
    recording: Recording
    analysis: Analysis
    commands: dict[int, tuple[Floats, Floats]]
    """By robot: times (k,) s, and commanded accelerations of its hand (k, 2) m/s^2; NaN where it brakes."""

    def jumps(self, robot: int) -> tuple[Floats, Floats]:
        """Times (s) and sizes (m/s^2) of the steps of a robot's command, from tick to tick."""
        t, u = self.commands[robot]
        # One that begins to drive comes from rest; one that ends brakes as its plant does.
        before = np.where(np.isnan(u[:-1]), 0.0, u[:-1])
        return t[1:], np.hypot(*(u[1:] - before).T)


def drive(kind: str) -> Drive:
    """Drives `reserve` with docs/orders/KIND.toml until the end of its window."""
    overrides = [f"fleet.duration_s={WINDOWS_S[kind][1]}"]
    fleet = resolved(load_fleet(fleet_path("reserve"), overrides, orders=ORDERS / f"{kind}.toml"))
    data = RunData(fleet, mode="simulate")
    simulation = Simulation(fleet, lambda time_ns, key, payload: data.feed(time_ns, key, decode(payload)))
    simulation.run()
    if simulation.reasons:
        raise RuntimeError(" ".join(simulation.reasons))
    recording = data.recording()
    commands = {robot.id: _commands(recording, fleet, robot.id) for robot in fleet.robots}
    return Drive(fleet, recording, analyse(recording, resolve(fleet)), commands)


def _commands(recording: Recording, fleet: Fleet, robot: int) -> tuple[Floats, Floats]:
    """What a robot's wrenches make of its hand: acceleration (4) in the middle of each plant period."""
    body, plant = fleet.robot(robot), recording.robots[robot].plant
    half_s = 0.5 * fleet.period_ns / NS_PER_S
    names = ("x", "y", "heading", "speed", "yaw_rate", "force", "torque", "driving")
    found = []
    for *at, force, torque, driving in zip(*(plant[name].tolist() for name in names), strict=True):
        if not driving:
            found.append((np.nan, np.nan))
            continue
        pose = hand.advance(Pose(*at), force, torque, body.mass_kg, body.inertia_kgm2, half_s)
        found.append(
            hand_acceleration(force, torque, pose, body.mass_kg, body.inertia_kgm2, body.hand_offset_m)
        )
    return plant.t, np.array(found)


def worst(driven: Drive, window_s: tuple[float, float]) -> tuple[float, float, int]:
    """The largest step of any robot's command within a window: m/s^2, s, whose."""
    found = []
    for robot in driven.commands:
        t, size = driven.jumps(robot)
        size = np.where((t >= window_s[0]) & (t <= window_s[1]), size, np.nan)
        if np.isfinite(size).any():
            k = int(np.nanargmax(size))
            found.append((float(size[k]), float(t[k]), robot))
    return max(found)


def run(_: Options) -> Result:
    result = Result()
    rows = []
    for kind, window_s in WINDOWS_S.items():
        driven = drive(kind)
        limit = driven.fleet.control.max_acceleration
        jump, t_s, robot = worst(driven, window_s)
        note = f"robot {robot} at {t_s:.2f} s"
        result.figures.append(Figure(f"{kind}: largest step of a command", jump, "m/s2", limit, note=note))
        for change, after_s in driven.analysis.changes:
            settled = "-" if after_s is None else f"{after_s:.1f}"
            rows.append([change.note, f"{change.t_s:.2f}", settled])
    result.details += table(["change", "at s", "settled after s"], rows)
    return result


# --- figures -------------------------------------------------------------------------------------


def picture(kind: str, driven: Drive) -> Picture:
    """Paths, distances and commands round a change."""
    window_s = WINDOWS_S[kind]
    figure = new_figure(8.6, 5.0)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.5))
    _draw_paths(figure.add_subplot(grid[:, 0]), driven, window_s)
    over_time = figure.add_subplot(grid[0, 1])
    _draw_distances(over_time, driven)
    commands = figure.add_subplot(grid[1, 1], sharex=over_time)
    _draw_commands(commands, driven, window_s)
    for axes in (over_time, commands):
        axes.set_xlim(*window_s)
        for change, _ in driven.analysis.changes:
            axes.axvline(change.t_s, color=PALETTE[0], linewidth=0.9, linestyle=(0, (4, 2)), zorder=1.6)
    for change, _ in driven.analysis.changes:
        over_time.annotate(
            change.note, (change.t_s, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -2),
            textcoords="offset points", ha="left", va="top", fontsize=8, color=PALETTE[0], zorder=7,
        )  # fmt: skip
    commands.set_xlabel("fleet time (s)")
    return figure


def _draw_paths(axes: Axes, driven: Drive, window_s: tuple[float, float]) -> None:
    a = driven.analysis
    rows = (a.grid >= window_s[0]) & (a.grid <= window_s[1])
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    for index, robot in enumerate(a.ids):
        path = a.hands[rows, index]
        axes.plot(*a.desired[rows, index].T, linestyle=DOTTED, color=GREY, linewidth=1.0, zorder=2)
        axes.plot(*path.T, color=nth_color(index), linewidth=1.5, zorder=3)
        axes.plot(
            *path[0], "o", markersize=11, markerfacecolor="white", markeredgecolor=nth_color(index),
            markeredgewidth=1.3, zorder=7,
        )  # fmt: skip
        axes.annotate(str(robot), path[0], ha="center", va="center_baseline", fontsize=7, zorder=8)
    moments = [window_s[0], *(change.t_s - 0.1 for change, _ in a.changes[1:]), window_s[1]]
    for shade, t_s in zip(np.linspace(0.5, 0.1, len(moments)), moments, strict=True):
        k = min(int(np.searchsorted(a.grid, t_s)), len(a.grid) - 1)
        edges = a.edges[np.isfinite(a.wanted[k])]
        lines = LineCollection(
            [a.hands[k][edge] for edge in edges], colors=str(shade), linewidths=1.3, zorder=5
        )
        axes.add_collection(lines)
        places = a.hands[k][np.unique(edges)]
        axes.annotate(
            f"{t_s:.0f} s", (places[:, 0].min(), places[:, 1].mean()), xytext=(-8, 0),
            textcoords="offset points", ha="right", va="center", fontsize=8, color=INK, zorder=9,
        )  # fmt: skip


def _draw_distances(axes: Axes, driven: Drive) -> None:
    a = driven.analysis
    axes.set_ylabel("distance of edges (m)")
    for index in range(len(a.edges)):
        in_force = np.isfinite(a.wanted[:, index])
        axes.plot(a.grid, np.where(in_force, a.wanted[:, index], np.nan), linestyle=DOTTED, color=GREY)
        axes.plot(
            a.grid, np.where(in_force, a.distances[:, index], np.nan), color=nth_color(index), linewidth=1.2
        )
    axes.axhline(driven.fleet.formation.safe_distance_m, color="#C1121F", linestyle=(0, (5, 3)))
    axes.set_ylim(0.0, None)


def _draw_commands(axes: Axes, driven: Drive, window_s: tuple[float, float]) -> None:
    axes.set_ylabel("commanded acceleration (m/s²)")
    for index, (t, u) in enumerate(driven.commands.values()):
        axes.plot(t, np.hypot(*u.T), color=nth_color(index), linewidth=1.1)
    jump, t_s, robot = worst(driven, window_s)
    t, u = driven.commands[robot]
    k = int(np.searchsorted(t, t_s))
    axes.plot(t[k], hypot(*u[k]), "v", color=INK, markersize=5, zorder=6)
    axes.annotate(
        f"largest step from tick to tick: {jump:.2f} m/s² (robot {robot}, {t_s:.2f} s); "
        f"the limit is {driven.fleet.control.max_acceleration:g}",
        (1.0, 1.0), xycoords="axes fraction", xytext=(-2, -2), textcoords="offset points",
        ha="right", va="top", fontsize=8, zorder=9,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
    top = axes.get_ylim()[1]
    axes.set_ylim(0.0, 1.15 * top)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.membership")
    parser.add_argument("folder", type=Path, metavar="DIR", help="where the figures go")
    options = parser.parse_args(arguments)
    for kind in WINDOWS_S:
        write(options.folder / f"membership-{kind}.png", partial(picture, kind, drive(kind)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
