"""What others take for the same task, beside `virtual_time`: robots, each from its start to its goal.

Run as a program, by a Python that has them, it reads the task as JSON and prints what each took, as JSON.
They are no part of what handfast needs, nor of its locked versions; have them in an environment of their
own::

    python -m venv /tmp/others && /tmp/others/bin/pip install ir-sim pyrvo
    OTHER_SIMULATORS=/tmp/others/bin/python python -m tests.benchmarks virtual_time
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from importlib.metadata import version
from math import atan2, hypot
from typing import Any, Final, NamedTuple

PYTHON: Final = "OTHER_SIMULATORS"
"""Names the Python that has them; without it, the one that runs the benchmarks."""
INSTALL: Final = "pip install ir-sim pyrvo"
RADIUS_M: Final = 0.1
TURN_MAX: Final = 3.0
TIMEOUT_S: Final = 600.0


class Task(NamedTuple):
    """Robots that drive for so many steps; starts and goals are (x, y) m."""

    starts: Sequence[tuple[float, float]]
    goals: Sequence[tuple[float, float]]
    speed: float
    step_s: float
    steps: int

    @property
    def robot_s(self) -> float:
        """Robots by seconds."""
        return len(self.starts) * self.steps * self.step_s


class Took(NamedTuple):
    """What one took: seconds of a processor, without imports and set-up, and how far the farthest robot ended
    from its goal, m."""

    name: str
    cpu_s: float
    off_m: float


def measured(task: Task) -> tuple[list[Took], list[str]]:
    """What each of them took that is installed; and of the others, what to say."""
    done = subprocess.run(
        [os.environ.get(PYTHON, sys.executable), "-P", __file__],
        input=json.dumps(task),
        capture_output=True,
        text=True,
        check=False,
        timeout=TIMEOUT_S,
        env=os.environ | {"MPLBACKEND": "Agg"},
    )
    if done.returncode:
        return [], [f"other simulators: {done.stderr.strip().splitlines()[-1:]}"]
    found = json.loads(done.stdout)
    return [Took(*each) for each in found["took"]], found["lacking"]


def _ir_sim(task: Task) -> Took:
    """ir-sim: differential drives that dodge each other by reciprocal velocity obstacles, all in Python."""
    irsim: Any = import_module("irsim")
    headings = [
        atan2(goal[1] - start[1], goal[0] - start[0])
        for start, goal in zip(task.starts, task.goals, strict=True)
    ]
    most, turn = task.speed, TURN_MAX
    robots = {
        "number": len(task.starts),
        "distribution": {"name": "manual"},
        "kinematics": {"name": "diff"},
        "shape": {"name": "circle", "radius": RADIUS_M},
        "state": [[*start, heading] for start, heading in zip(task.starts, headings, strict=True)],
        "goal": [[*goal, 0.0] for goal in task.goals],
        "vel_min": [-most, -turn],
        "vel_max": [most, turn],
        "behavior": {"name": "rvo", "vxmax": most, "vymax": most, "acce": 2.0, "factor": 1.0},
    }
    world = {
        "height": 100, "width": 100, "offset": [-50, -50], "step_time": task.step_s,
        "sample_time": task.step_s, "collision_mode": "unobstructed",
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as folder:
        path = os.path.join(folder, "world.yaml")
        with open(path, "w", encoding="utf-8") as file:
            json.dump({"world": world, "robot": [robots]}, file)  # JSON is YAML as well
        there = irsim.make(path, display=False, log_level="ERROR")
        begun = time.process_time()
        for _ in range(task.steps):
            there.step()
        took = time.process_time() - begun
        ends = [(float(robot.state[0, 0]), float(robot.state[1, 0])) for robot in there.robot_list]
    return Took(f"ir-sim {version('ir-sim')}, differential drive with RVO", took, _off(ends, task))


def _rvo2(task: Task) -> Took:
    """RVO2's step alone: points that take any velocity at once, in C++; Python only says where to."""
    pyrvo: Any = import_module("pyrvo")
    simulator = pyrvo.RVOSimulator()
    simulator.set_time_step(task.step_s)
    simulator.set_agent_defaults(5.0, 10, 2.0, 2.0, RADIUS_M, task.speed)
    robots = [simulator.add_agent(tuple(start)) for start in task.starts]
    took = 0.0
    for _ in range(task.steps):
        for robot, goal in zip(robots, task.goals, strict=True):
            x, y = simulator.get_agent_position(robot).to_tuple()
            away_x, away_y = goal[0] - x, goal[1] - y
            share = min(1.0, task.speed / max(hypot(away_x, away_y), 1e-9))
            simulator.set_agent_pref_velocity(robot, (share * away_x, share * away_y))
        begun = time.process_time()
        simulator.do_step()
        took += time.process_time() - begun
    ends = [simulator.get_agent_position(robot).to_tuple() for robot in robots]
    return Took(f"RVO2's step alone (pyrvo {version('pyrvo')})", took, _off(ends, task))


def _off(ends: Sequence[tuple[float, float]], task: Task) -> float:
    return max(hypot(x - u, y - v) for (x, y), (u, v) in zip(ends, task.goals, strict=True))


_OTHERS: Final[dict[str, Callable[[Task], Took]]] = {"irsim": _ir_sim, "pyrvo": _rvo2}


def _main() -> None:
    task = Task(*json.load(sys.stdin))
    took, lacking = [], []
    for module, measure in _OTHERS.items():
        try:
            with redirect_stdout(sys.stderr):
                took.append(measure(task))
        except ModuleNotFoundError as error:
            if error.name != module:
                raise
            lacking.append(f"{module}: not installed ({INSTALL}); its figure is left out")
    print(json.dumps({"took": took, "lacking": lacking}))


if __name__ == "__main__":
    _main()
