"""What pages are measured with: 6 robots that drive, on real processes, and the server of a page."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import tomli_w

from agent.fleet.loading import load_fleet, to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolved
from deploy.console.arguments import fleet_path
from deploy.processes.placement import place
from tests.benchmarks.processes import BenchmarkError, Group, Observer, environment, handfast, start_handfast

READY_S = 20.0


class Driving(NamedTuple):
    """A fleet that drives, the file that its robots read, and who has it driven."""

    fleet: Fleet
    file: Path
    observer: Observer


class Served(NamedTuple):
    """The process of ``handfast view`` and the address of its page."""

    pid: int
    address: str


@contextmanager
def driving(folder: Path) -> Iterator[Driving]:
    """The delta, for as long as it is looked at; its logs and its file are in `folder`."""
    fleet, ports, _ = place(resolved(load_fleet(fleet_path("delta"))))
    try:
        fleet_file = folder / "fleet.toml"
        fleet_file.write_text(tomli_w.dumps(to_dict(fleet)), encoding="utf-8")
        with Group(folder) as robots:
            start_handfast(robots, fleet, fleet_file)
            with Observer(fleet, robots) as observer:
                observer.wait_alive()
                observer.drive()
                yield Driving(fleet, fleet_file, observer)
    finally:
        ports.close()


@contextmanager
def served(what: Path, folder: Path, ready_s: float = READY_S) -> Iterator[Served]:
    """``handfast view`` of a fleet's file or of the folder of a run; what it says is in `folder`.

    Args:
        ready_s: it has its page by then.
    """
    out = folder / "view.out"
    with open(out, "wb") as stream:
        command = handfast("view", str(what), "--no-browser")
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())
    try:
        end = time.monotonic() + ready_s
        while not (address := re.search(r"http://\S+", out.read_text())):
            if time.monotonic() > end or process.poll() is not None:
                raise BenchmarkError(f"no page: {out.read_text()[-500:]}")
            time.sleep(0.05)
        yield Served(process.pid, address[0])
    finally:
        process.kill()
        process.wait()
