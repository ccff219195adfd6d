"""Kinds of plant: what a robot's `plant` may be, and all that the rest must know of one (PURE).

A kind of ours is an entry of `KINDS`, any other one the class of a plugin. Modules are named, not imported.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from agent.common import plugins
from agent.common.settings import Entry, section_entry
from agent.common.wording import nearest, show
from agent.fleet.mavlink_section import MavlinkSection

GROUP: Final = "handfast.plants"
"""Group of entry points that are plants of others."""


class Kind(NamedTuple):
    """One kind of plant.

    Attributes:
        name: as `plant` has it.
        section: its table in the fleet file; None: it has none.
        local: fields of that table which only its own computer needs: not part of the digest.
    """

    name: str
    section: Entry | None = None
    local: tuple[str, ...] = ()


KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind("unicycle"),
        Kind(
            "mavlink",
            section_entry(
                "mavlink",
                MavlinkSection,
                'How a robot with `plant = "mavlink"` is reached, and what it may do (docs/rovers.md). In '
                "`[robot_defaults.mavlink]` for all, in `[robot.mavlink]` below a `[[robot]]` for one, which "
                "then takes what it leaves out from the former. `connection`, `baud` and `signing_key` are "
                "not part of the digest.",
            ),
            local=("connection", "baud", "signing_key"),
        ),
    )
}


def built_in_sections() -> Iterable[Entry]:
    """Tables of the kinds of ours."""
    return [kind.section for kind in KINDS.values() if kind.section is not None]


def kind(reference: str) -> Kind:
    """The kind of plant that a robot's `plant` names.

    Raises:
        agent.common.plugins.PluginError: there is none.
    """
    known = KINDS.get(reference)
    return known or Kind(reference, plugins.section(load(reference), reference, ()))


def load(reference: str) -> type[Any]:
    """The class of a plant of others.

    Raises:
        agent.common.plugins.PluginError: there is none.
    """
    try:
        return plugins.load(reference, GROUP)
    except plugins.PluginError as error:
        if ":" in reference:
            raise
        near = nearest(reference, KINDS)
        hint = f"; did you mean {show(near)}?" if near else f": {error}"
        known = ", ".join(show(name) for name in KINDS)
        wrong = f"must be one of {known}, or a plugin, got {show(reference)}{hint}"
        raise plugins.PluginError(wrong) from None
