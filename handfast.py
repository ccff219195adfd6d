"""Handfast from Python: load a fleet, drive it in virtual time or with processes, look at what came of it::

    import handfast

    recording = handfast.simulate("delta")
    recording.plot().savefig("delta.png")

``docs/python.md`` has the rest. What is named here stays as it is; what is not may change. Each name is
imported when it is first used, so that a plant or a law that is written with this module loads on a robot,
where only what drives one is installed.
"""

from __future__ import annotations

from importlib import import_module
from importlib.machinery import PathFinder
from os.path import dirname
from typing import TYPE_CHECKING, Any, Final

for _name in ("agent", "plant", "bridges", "deploy"):  # before anything of them runs; as in deploy/cli.py
    _ours, _found = PathFinder.find_spec(_name, [dirname(__file__)]), PathFinder.find_spec(_name)
    if _ours and _found and _found.origin and _ours.origin != _found.origin:
        raise ImportError(f"{_found.origin} takes the place of handfast's package {_name}: rename it")

from agent.common.errors import Error as Error
from agent.common.errors import packages_named

if TYPE_CHECKING:
    from agent.common.plugins import register as register
    from agent.common.settings import about as about
    from agent.common.settings import setting as setting
    from agent.control.hand import Pose as Pose
    from agent.control.law_plugin import Law as Law
    from agent.control.law_plugin import Moment as Moment
    from agent.control.law_plugin import Neighbour as Neighbour
    from agent.control.law_plugin import Reference as Reference
    from agent.fleet.model import FleetError as FleetError
    from deploy.api.drive import run as run
    from deploy.api.drive import simulate as simulate
    from deploy.api.fleet import Changes as Changes
    from deploy.api.fleet import Findings as Findings
    from deploy.api.fleet import Fleet as Fleet
    from deploy.api.fleet import check as check
    from deploy.api.fleet import fleets as fleets
    from deploy.api.fleet import load as load
    from deploy.api.fleet import scenarios as scenarios
    from deploy.api.recording import Recording as Recording
    from deploy.api.recording import load_recording as load_recording
    from deploy.api.sweep import Sweep as Sweep
    from deploy.api.sweep import sweep as sweep
    from deploy.check.finding import Finding as Finding
    from plant.backend import Command as Command
    from plant.backend import Plant as Plant
    from plant.backend import Reading as Reading
    from plant.backend import Setup as Setup

_MODULES: Final = {
    # for laws and plants of one's own
    "Command": "plant.backend",
    "FleetError": "agent.fleet.model",
    "Law": "agent.control.law_plugin",
    "Moment": "agent.control.law_plugin",
    "Neighbour": "agent.control.law_plugin",
    "Plant": "plant.backend",
    "Pose": "agent.control.hand",
    "Reading": "plant.backend",
    "Reference": "agent.control.law_plugin",
    "Setup": "plant.backend",
    "about": "agent.common.settings",
    "register": "agent.common.plugins",
    "setting": "agent.common.settings",
    # for whoever drives a fleet
    "Changes": "deploy.api.fleet",
    "Finding": "deploy.check.finding",
    "Findings": "deploy.api.fleet",
    "Fleet": "deploy.api.fleet",
    "Recording": "deploy.api.recording",
    "Sweep": "deploy.api.sweep",
    "check": "deploy.api.fleet",
    "fleets": "deploy.api.fleet",
    "load": "deploy.api.fleet",
    "load_recording": "deploy.api.recording",
    "run": "deploy.api.drive",
    "scenarios": "deploy.api.fleet",
    "simulate": "deploy.api.drive",
    "sweep": "deploy.api.sweep",
}
"""Names -> modules that have them."""

__all__ = sorted(["Error", *_MODULES])


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'handfast' has no attribute {name!r}")
    with packages_named(f"handfast.{name}"):
        value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
