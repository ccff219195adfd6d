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
from typing import TYPE_CHECKING, Any, Final

from agent.common.errors import Error, packages_named

if TYPE_CHECKING:
    from agent.common.settings import about as about
    from agent.common.settings import setting as setting
    from agent.control.hand import Pose as Pose
    from agent.control.law_plugin import Law as Law
    from agent.control.law_plugin import Moment as Moment
    from agent.control.law_plugin import Neighbour as Neighbour
    from agent.fleet.model import FleetError as FleetError
    from plant.backend import Command as Command
    from plant.backend import Reading as Reading

_MODULES: Final = {
    # for laws and plants of one's own
    "Command": "plant.backend",
    "FleetError": "agent.fleet.model",
    "Law": "agent.control.law_plugin",
    "Moment": "agent.control.law_plugin",
    "Neighbour": "agent.control.law_plugin",
    "Pose": "agent.control.hand",
    "Reading": "plant.backend",
    "about": "agent.common.settings",
    "setting": "agent.common.settings",
    # for whoever drives a fleet
}
"""Names -> modules that have them."""

__all__ = [
    "Command",
    "Error",
    "FleetError",
    "Law",
    "Moment",
    "Neighbour",
    "Pose",
    "Reading",
    "about",
    "setting",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'handfast' has no attribute {name!r}")
    with packages_named(f"handfast.{name}"):
        value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
