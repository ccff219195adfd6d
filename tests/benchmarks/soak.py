"""A long run of twelve processes in which one is killed every few seconds, and started again.

`handfast run delta` with fault rules that a seed draws: an agent or a plant of robots 2 to 6 is killed, and
started again at once or up to two seconds later. Robot 1 is left alone, so that its processes show whether
memory grows over the whole time, as does the command's own. All links lose a message in a hundred, by a
rule: so every message of the drive has a decision, which the run's audit makes again and counts.
"""

from __future__ import annotations

import json
import random
import re
import signal
import subprocess
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from agent.supervision.state_machine import State
from deploy.recording.mcap_reader import read_run
from deploy.recording.recording import Recording
from tests.benchmarks.figures import Figure, Options, Result, number
from tests.benchmarks.processes import BenchmarkError, end, environment, handfast, state_of
from tests.benchmarks.startup import children_of

MINUTES: Final = 10.0
QUICK_MINUTES: Final = 2.0
SEED: Final = 5
EVERY_S: Final = 5.0
DOWN_MAX_S: Final = 2.0
QUIET_S: Final = 25.0
"""At the end nothing is killed: the oracle of recovery gives robots 20 s to be in formation again."""
SPARED: Final = 1
KILLED: Final = (2, 3, 4, 5, 6)
ROBOTS: Final = 6
SAMPLE_S: Final = 1.0
SETTLED_S: Final = 60.0
"""Memory is looked at from then on: until then all that is loaded late has been."""
GROWTH_MB: Final = 1.0
"""In ten minutes, of one process."""
RUN: Final = "handfast run"
FORMATION_M: Final = 0.05
SAFE_M: Final = 0.22


@dataclass
class Memory:
    """Resident memory of one process over time."""

    t_s: list[float] = field(default_factory=list)
    mb: list[float] = field(default_factory=list)

    def slope(self, since_s: float = SETTLED_S) -> float:
        """MB in ten minutes, by least squares from `since_s` of its life on; nan when it is too short."""
        t, mb = np.array(self.t_s), np.array(self.mb)
        late = t >= t[0] + since_s
        if late.sum() < 10:
            return float("nan")
        return float(np.polyfit(t[late], mb[late], 1)[0]) * 600.0


def rules(seed: int, duration_s: float) -> str:
    """The scenario: one kill every `EVERY_S`, each after the one before is over."""
    draw = random.Random(seed)
    out = ['[[faults.rule]]\nname = "lossy"\nloss = "1%"\n']
    for k in range(int((duration_s - QUIET_S) / EVERY_S)):
        at = EVERY_S * k + draw.uniform(0.5, EVERY_S - DOWN_MAX_S - 0.5)
        robot, role = draw.choice(KILLED), draw.choice(("agent", "plant"))
        down_s = 0.0 if draw.random() < 0.5 else draw.uniform(0.2, DOWN_MAX_S)
        what = f'restart = "{role}"' if not down_s else f'kill = "{role}"\nfor = {down_s:.2f}'
        out.append(f'[[faults.rule]]\nname = "kill {k + 1}"\nrobot = {robot}\n{what}\nat = {at:.2f}\n')
    return "\n".join(out)


def rss_mb(pid: int) -> float:
    """Resident memory of a process, MB; nan when it is gone."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return float("nan")
    found = re.search(r"VmRSS:\s+(\d+) kB", text)
    return int(found[1]) / 1024.0 if found else float("nan")


def processes_of(pid: int) -> dict[str, int]:
    """The run's own process and its robots', by name, that live now."""
    found = {RUN: pid}
    for child in children_of(pid):
        try:
            words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        if "--robot" in words and "-m" in words and state_of(child) not in ("", "Z"):
            found[f"robot {words[words.index('--robot') + 1]}'s {words[words.index('-m') + 1]}"] = child
    return found


def watch(process: subprocess.Popen[bytes], until_s: float) -> tuple[dict[str, Memory], int]:
    """Memory of all processes of a run for its time; also how many there were when it was half over."""
    lives: dict[tuple[str, int], Memory] = {}
    begun, half = time.monotonic(), 0
    while process.poll() is None and (t := time.monotonic() - begun) < until_s:
        here = processes_of(process.pid)
        for name, pid in here.items():
            memory = lives.setdefault((name, pid), Memory())
            mb = rss_mb(pid)
            if mb == mb:
                memory.t_s.append(t)
                memory.mb.append(mb)
        half = max(half, len(here) - 1)
        time.sleep(SAMPLE_S)
    longest: dict[str, Memory] = {}
    for (name, _), memory in lives.items():
        if name not in longest or len(memory.t_s) > len(longest[name].t_s):
            longest[name] = memory
    return longest, half


def soak(folder: Path, duration_s: float) -> tuple[int, dict[str, Memory], int]:
    """Drives the run; returns its exit status, the memory of its longest-lived processes, how many lived."""
    scenario = folder / "rules.toml"
    scenario.write_text(rules(SEED, duration_s), encoding="utf-8")
    arguments = ("run", "delta", "--duration", f"{duration_s:g}", "--faults", str(scenario), "--no-report")
    with open(folder / "log", "wb") as log:
        process = subprocess.Popen(
            handfast(*arguments, "--out", str(folder / "out")),
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        memory, lived = watch(process, duration_s)
        children = processes_of(process.pid)
        status = process.wait(duration_s + 300.0)
    except BaseException:
        process.send_signal(signal.SIGINT)
        end(process, 10.0)
        raise
    left = [name for name, pid in children.items() if state_of(pid) not in ("", "Z")]
    if left:
        raise BenchmarkError(f"still there after the run: {', '.join(left)}")
    return status, memory, lived


def run(options: Options) -> Result:
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    duration_s = 60.0 * minutes
    with tempfile.TemporaryDirectory(prefix="handfast-bench-") as name:
        folder = Path(name)
        status, memory, lived = soak(folder, duration_s)
        if not (folder / "out" / "metrics.json").exists():
            raise BenchmarkError((folder / "log").read_text(errors="replace")[-2000:])
        metrics = json.loads((folder / "out" / "metrics.json").read_text())
        recording = read_run(folder / "out")
        kills = Counter(event.role for event in recording.events if event.what == "kill")
        running = sum(last_state(recording, robot) == State.RUNNING.value for robot in recording.ids)
    if status != (0 if metrics["verdict"]["passed"] else 1):
        raise BenchmarkError(f"the run ended with {status}")
    return _result(metrics, memory, kills, lived, running, duration_s)


def last_state(recording: Recording, robot: int) -> str:
    """What an agent said last within the drive."""
    status = recording.robots[robot].status
    before = int(np.searchsorted(status.t, recording.end_s - 0.5, side="right")) - 1
    return str(status.states[before]) if before >= 0 else ""


def _result(
    metrics: dict[str, Any],
    memory: dict[str, Memory],
    kills: Counter[str],
    lived: int,
    running: int,
    duration_s: float,
) -> Result:
    audit, oracles, verdict = metrics["links_audit"], metrics["oracles"], metrics["verdict"]
    violations = sum(found["violations"] for found in oracles.values())
    checked = ", ".join(name for name, found in oracles.items() if found["checked"])
    killed = f"agents {kills['agent']}, plants {kills['plant']}"
    lost = f"{metrics['injected']['rate']:.2%} lost by rule"
    result = Result(
        [
            Figure("length", duration_s / 60.0, "min", note=f"{lived} processes, seed {SEED}"),
            Figure(f"kills, one every {EVERY_S:g} s", sum(kills.values()), note=killed),
            Figure("robots that drive by the law at the end", running, "", ROBOTS, at_most=False),
            Figure("last distance error", metrics["final_distance_error_m"], "m", FORMATION_M),
            Figure("oracles violated", violations, "", 0, note=f"checked: {checked}"),
            Figure("reasons against the run's verdict", len(verdict["reasons"]), "", 0),
            Figure("messages whose fate is known", audit["decided"], note=lost),
            *(
                Figure(f"messages whose fate is {what}", audit[what], "", 0)
                for what in ("differing", "unrecorded", "unheard")
            ),
            Figure("messages rejected", metrics["messages"]["rejected"], "", 0),
            Figure(
                "least distance of two hands", metrics["min_distance_m"]["any"], "m", SAFE_M, at_most=False
            ),
            *(_growth(f"robot {SPARED}'s {role}", memory, GROWTH_MB) for role in ("agent", "plant")),
            _growth(RUN, memory, None),
        ],
        [f"against the verdict: {reason}" for reason in verdict["reasons"]],
    )
    for name, life in sorted(memory.items()):
        slope = life.slope()
        grown = f", {slope:+.2f} MB in 10 min after the first minute" if slope == slope else ""
        lasted = f"longest life {life.t_s[-1] - life.t_s[0]:.0f} s"
        result.details.append(f"{name}: {lasted}, {life.mb[0]:.1f} to {life.mb[-1]:.1f} MB{grown}")
    return result


def _growth(name: str, memory: dict[str, Memory], limit: float | None) -> Figure:
    life = memory[name]
    note = f"{number(life.mb[0])} to {number(life.mb[-1])} MB in {life.t_s[-1] - life.t_s[0]:.0f} s"
    if limit is None:
        half_s = 0.5 * (life.t_s[-1] - life.t_s[0])
        note += f"; last half: {number(life.slope(half_s))}; part of it is MCAP's index of the recording"
    return Figure(f"memory of {name}, growth", life.slope(), "MB in 10 min", limit, note=note)
