"""Where a fleet's files are on a robot's computer (PURE)."""

from __future__ import annotations

import hashlib

from agent.fleet.fleet import Fleet
from deploy.hosts.units import Places


def fleet_file(fleet: Fleet, text: str) -> str:
    """Place of the fleet file within our folder there; another text has another one, so units change."""
    return f"fleets/{fleet.fleet.name}/fleet-{hashlib.sha256(text.encode()).hexdigest()[:8]}.toml"


def places(fleet: Fleet, root: str, version: str, text: str) -> Places:
    """All places that units name.

    Args:
        root: our folder there.
        version: what is installed there.
        text: of the fleet file that robots read.
    """
    base = f"{root}/fleets/{fleet.fleet.name}"
    return Places(
        version=f"{root}/versions/{version}",
        fleet_file=f"{root}/{fleet_file(fleet, text)}",
        keys=f"{base}/keys" if fleet.is_secured else None,
        recordings=f"{base}/recordings",
        state=f"{base}/state",
    )
