"""Kinds of plant: what a robot's `plant` may be, and all that the rest must know of one (PURE).

A kind of ours is an entry of `KINDS`, any other one the class of a plugin. Modules are named, not imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final, NamedTuple

from handfast.agent.common import plugins
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Entry, section_entry
from handfast.agent.common.wording import did_you_mean, show
from handfast.agent.fleet.mavlink_section import LINK_FIELDS, MavlinkSection, check_links

GROUP: Final = "handfast.plants"
"""Group of entry points that are plants of others."""
BASE: Final = "handfast.plant.backend:Plant"
"""What the class of a plant of others is derived from."""


class Kind(NamedTuple):
    """One kind of plant.

    Attributes:
        name: as `plant` has it; of a plugin its reference.
        says: what drives, for people.
        body: ``module:function`` that makes its body in its process, (fleet, robot, `plant.backend.Begin`) ->
            body; "" where its program has a way of its own.
        virtual: as `body`, of what stands for it in virtual time.
        program: module of its process.
        simulator: module of the process that can stand in for the body; "" where there is none.
        vehicle: whether the body is a real one: it is looked at before a drive, and stands where the world
            has it. Any other starts where the fleet file says, and its place is kept for it.
        rolls_on_s: for so long the body goes on as it went once nothing can command it any more, s, and stops
            then: it has a watchdog of its own, which no setting makes faster.
        turns: field of its table that limits how fast the body turns, rad/s; "" where none does.
        needs_datum: whether its place is one on the earth.
        section: its table in the fleet file; None: it has none.
        local: fields of that table which only its own computer needs: not part of the digest.
        check: adds what does not go together in rows of such robots, with their numbers.
    """

    name: str
    says: str = ""
    body: str = ""
    virtual: str = ""
    program: str = "handfast.plant"
    simulator: str = ""
    vehicle: bool = False
    rolls_on_s: float = 0.0
    turns: str = ""
    needs_datum: bool = False
    section: Entry | None = None
    local: tuple[str, ...] = ()
    check: Callable[[str, Sequence[tuple[int, Mapping[str, Any]]], Reader], None] | None = None

    @property
    def is_plugin(self) -> bool:
        """Whether it is a class of others."""
        return self.name not in KINDS


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind(
            "unicycle",
            "is simulated",
            body="handfast.plant.unicycle:begin",
            virtual="handfast.plant.unicycle:begin",
        ),
        Kind(
            "mavlink",
            "is an ArduPilot Rover, which `[robot.mavlink]` and `[datum]` tell of",
            virtual="handfast.bridges.mavlink.simulator.in_memory:begin",
            program="handfast.bridges.mavlink",
            simulator="handfast.bridges.mavlink.simulator",
            vehicle=True,
            rolls_on_s=3.0,  # ArduRover, measured: it hears no setpoint for so long
            turns="max_yaw_rate_radps",
            needs_datum=True,
            section=section_entry(
                "mavlink",
                MavlinkSection,
                'How a robot with `plant = "mavlink"` is reached, and what it may do (docs/rovers.md). In '
                "`[robot_defaults.mavlink]` for all, in `[robot.mavlink]` below a `[[robot]]` for one, which "
                "then takes what it leaves out from the former. `connection`, `baud` and `signing_key` are "
                "not part of the digest.",
            ),
            local=LINK_FIELDS,
            check=check_links,
        ),
    )
}
DEFAULT: Final = next(iter(KINDS))


def built_in_sections() -> Iterable[Entry]:
    """Tables of the kinds of ours."""
    return [kind.section for kind in KINDS.values() if kind.section is not None]


def kind(reference: str) -> Kind:
    """The kind of plant that a robot's `plant` names.

    Raises:
        handfast.agent.common.plugins.PluginError: there is none.
    """
    return KINDS.get(reference) or _kind_of_class(load(reference), reference)


def _kind_of_class(plugin: type[Any], reference: str) -> Kind:
    return Kind(
        reference,
        body="handfast.plant.plugin:begin",
        virtual="handfast.plant.plugin:begin_virtual",
        vehicle=bool(plugin.vehicle),
        rolls_on_s=float(plugin.rolls_on_s),
        section=plugins.section(plugin, reference, ()),
    )


def attribute(reference: str) -> Any:
    """What a ``module:name`` of ours is, imported now."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def load(reference: str) -> type[Any]:
    """The class of a plant of others.

    Raises:
        handfast.agent.common.plugins.PluginError: there is none.
    """
    try:
        plugin = plugins.load(reference, GROUP, BASE)
        simulated = plugins.declared(plugin, reference, "simulated")
        if simulated is not None:
            plugins.require(simulated, BASE, f"{reference}: simulated = {show(simulated)}")
        return plugin
    except plugins.PluginError as error:
        if ":" in reference:
            raise
        question = did_you_mean(reference, KINDS, show)
        hint = f"; {question}" if question else f": {error}"
        known = ", ".join(show(name) for name in KINDS)
        wrong = f"must be one of {known}, or a plugin, got {show(reference)}{hint}"
        raise plugins.PluginError(wrong) from None
