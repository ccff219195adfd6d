"""Handfast from Python: load a fleet, drive it in virtual time or with processes, look at what came of it::

    import handfast

    recording = handfast.simulate("delta")
    recording.plot().savefig("delta.png")

``docs/python.md`` has the rest. What is named here stays as it is; what is not may change. Each name is
imported when it is first used, so that a plant or a law that is written with this module loads on a robot,
where only what drives one is installed.
"""

from __future__ import annotations

TYPE_CHECKING = False  # typing would have to be imported for it; type checkers take the name as it is meant
if TYPE_CHECKING:
    from typing import Any, Final

    from handfast.agent.common.errors import Error as Error
    from handfast.agent.common.plugins import register as register
    from handfast.agent.common.settings import about as about
    from handfast.agent.common.settings import setting as setting
    from handfast.agent.control.hand import Pose as Pose
    from handfast.agent.control.own_law import Law as Law
    from handfast.agent.control.own_law import Moment as Moment
    from handfast.agent.control.own_law import Neighbour as Neighbour
    from handfast.agent.control.own_law import Reference as Reference
    from handfast.agent.fleet.model import FleetError as FleetError
    from handfast.deploy.api.drive import run as run
    from handfast.deploy.api.drive import simulate as simulate
    from handfast.deploy.api.fleet import Changes as Changes
    from handfast.deploy.api.fleet import Findings as Findings
    from handfast.deploy.api.fleet import Fleet as Fleet
    from handfast.deploy.api.fleet import check as check
    from handfast.deploy.api.fleet import fleets as fleets
    from handfast.deploy.api.fleet import load as load
    from handfast.deploy.api.fleet import scenarios as scenarios
    from handfast.deploy.api.recording import Recording as Recording
    from handfast.deploy.api.recording import load_recording as load_recording
    from handfast.deploy.api.sweep import Sweep as Sweep
    from handfast.deploy.api.sweep import sweep as sweep
    from handfast.deploy.check.finding import Finding as Finding
    from handfast.plant.backend import Command as Command
    from handfast.plant.backend import Plant as Plant
    from handfast.plant.backend import Reading as Reading
    from handfast.plant.backend import Setup as Setup

__version__: str

_MODULES: Final = {
    "Error": "handfast.agent.common.errors",
    # for laws and plants of one's own
    "Command": "handfast.plant.backend",
    "FleetError": "handfast.agent.fleet.model",
    "Law": "handfast.agent.control.own_law",
    "Moment": "handfast.agent.control.own_law",
    "Neighbour": "handfast.agent.control.own_law",
    "Plant": "handfast.plant.backend",
    "Pose": "handfast.agent.control.hand",
    "Reading": "handfast.plant.backend",
    "Reference": "handfast.agent.control.own_law",
    "Setup": "handfast.plant.backend",
    "about": "handfast.agent.common.settings",
    "register": "handfast.agent.common.plugins",
    "setting": "handfast.agent.common.settings",
    # for whoever drives a fleet
    "Changes": "handfast.deploy.api.fleet",
    "Finding": "handfast.deploy.check.finding",
    "Findings": "handfast.deploy.api.fleet",
    "Fleet": "handfast.deploy.api.fleet",
    "Recording": "handfast.deploy.api.recording",
    "Sweep": "handfast.deploy.api.sweep",
    "check": "handfast.deploy.api.fleet",
    "fleets": "handfast.deploy.api.fleet",
    "load": "handfast.deploy.api.fleet",
    "load_recording": "handfast.deploy.api.recording",
    "run": "handfast.deploy.api.drive",
    "scenarios": "handfast.deploy.api.fleet",
    "simulate": "handfast.deploy.api.drive",
    "sweep": "handfast.deploy.api.sweep",
}
"""Names -> modules that have them."""

__all__ = sorted(["__version__", *_MODULES])


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name == "__version__":
        return import_module("handfast.agent.runtime.version").handfast_version()
    if name not in _MODULES:
        raise AttributeError(f"module 'handfast' has no attribute {name!r}")
    from handfast.agent.common.errors import packages_named

    with packages_named(f"handfast.{name}"):
        value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
