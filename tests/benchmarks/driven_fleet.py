"""The bundled delta on real processes, driving for as long as it is measured."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import tomli_w

from handfast.agent.fleet.loading import load_fleet, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.arguments import fleet_path
from handfast.deploy.processes.placement import place
from tests.benchmarks.processes import Group, Observer, start_handfast


class Driving(NamedTuple):
    """A fleet that drives, the file that its robots read, their processes, and who has it driven."""

    fleet: Fleet
    file: Path
    robots: Group
    observer: Observer


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
                yield Driving(fleet, fleet_file, robots, observer)
    finally:
        ports.close()
