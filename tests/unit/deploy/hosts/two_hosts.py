"""A fleet of six robots on two hosts, and what a host has that `handfast up` installs on."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Any

import tomli_w

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory.hosts import located

ROOT = "/home/pi/.local/share/handfast"
WHEELS = {"pip-26.3-py3-none-any.whl": "a", "numpy-2-cp311.whl": "b"}


def fleet(hosts: Mapping[str, Mapping[str, Any]] | None = None, **tables: dict[str, Any]) -> Fleet:
    """The bundled fleet on two hosts."""
    raw = tomllib.loads((FLEETS / "delta.toml").read_text(encoding="utf-8"))
    raw["host"] = hosts or {"rover1": {"address": "10.0.0.1"}, "rover2": {"address": "10.0.0.2"}}
    for index, robot in enumerate(raw["robot"]):
        robot["host"] = list(raw["host"])[index % len(raw["host"])]
    return located(resolved(parse_fleet(tomli_w.dumps(raw | tables), source="here")))
