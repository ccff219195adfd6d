"""Kinds of plant, and the tables of vehicles reached by MAVLink (PURE).

`KINDS` has an entry for each built-in kind; any other kind is the class of a plugin. Modules are named here,
not imported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, NamedTuple

from handfast.agent.common import plugins
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Entry, section_entry, setting
from handfast.agent.common.wording import did_you_mean, show

SIMULATOR: Final = "simulator"
"""As a connection: a simulated rover, which whoever starts the bridge starts as well."""
SHARED_LINKS: Final = ("tcp:", "udpout:")
"""What a connection begins with that several bridges may have, each to a vehicle of its own."""
LINK_FIELDS: Final = ("connection", "baud", "signing_key")
"""Fields of `MavlinkSection` that only say how its own computer reaches a vehicle."""
_HOST: Final = r"([A-Za-z0-9._-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])"
_LOOPBACK: Final = re.compile(r"localhost|127\.[0-9.]+|\[::1\]", re.IGNORECASE)
_PORT: Final = r"([1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"


@dataclass(frozen=True, slots=True)
class MavlinkSection:
    """``[robot.mavlink]``: one vehicle and the bridge to it."""

    connection: str | None = setting(
        None,
        "Where the vehicle is, as pymavlink writes it: `udpin:HOST:PORT` (it sends to this port), "
        "`udpout:HOST:PORT`, `tcp:HOST:PORT`, or a serial port, best by its id. `simulator`: `run` and "
        "`preflight` start a simulated rover. Each such robot needs one.",
        pattern=rf"simulator|(udpin|udpout|udp|tcp):{_HOST}:{_PORT}|/dev/[^\s,]{{1,200}}",
        pattern_says='"simulator", "udpin:HOST:PORT", "udpout:HOST:PORT", "tcp:HOST:PORT" or a serial port '
        'such as "/dev/serial/by-id/usb-ArduPilot..."',
        example='"udpin:0.0.0.0:14550"',
    )
    baud: int = setting(115_200, "Speed of a serial port.", unit="1/s", ge=1200, le=4_000_000)
    system: int | None = setting(
        None,
        "The vehicle's MAVLink system id (`SYSID_THISMAV`, `MAV_SYSID`). Left out: the first rover that is "
        "heard; give it where a link carries several, as that to a MAVLink router does.",
        ge=1,
        le=254,
        example="1",
    )
    state_rate_hz: float = setting(
        25.0,
        "How often the vehicle is to send position and attitude. It may grant less; 40 is ArduPilot's most, "
        "25 its steadiest.",
        unit="Hz",
        ge=5,
        le=50,
    )
    arm: bool = setting(
        False,
        "The bridge itself puts the vehicle into GUIDED and arms it, as soon as its estimate is good: "
        "**it may move without anybody at it having said so**. Else its operator does both.",
    )
    signing_key: str | None = setting(
        None,
        "File of the key that signs MAVLink messages, which nobody else may read. Left out: not signed.",
        pattern=r"[^\x00]{1,400}",
        pattern_says="a file name",
        example='"~/.config/handfast/rover1.key"',
    )
    max_speed_mps: float = setting(
        1.0, "Never asks for more, forward or in reverse.", unit="m/s", gt=0, le=20
    )
    max_acceleration: float = setting(
        0.8,
        "Never asks for a faster change of speed. Below the vehicle's own `ATC_ACCEL_MAX`.",
        unit="m/s2",
        gt=0,
        le=20,
    )
    max_yaw_rate_radps: float = setting(1.0, "Never asks for a faster turn.", unit="rad/s", gt=0, le=10)


def check_links(kind: str, rows: Sequence[tuple[int, Mapping[str, Any]]], reader: Reader) -> None:
    """Each of these robots is reached in a way of its own."""
    known: dict[tuple[str, str | None], list[tuple[int, Any]]] = {}
    for number, row in rows:
        if kind not in row:
            continue  # it has a problem of its own
        link = row[kind] if row[kind] is not None else {"connection": None}
        place = f"robot[{number}].{kind}.connection"
        connection = link.get("connection", SIMULATOR)  # one with a problem is not blamed for another
        if connection is None:
            reader.add(
                place,
                f'is missing: plant = {show(kind)} needs it, for example connection = "udpin:0.0.0.0:14550"',
            )
        elif connection != SIMULATOR:
            # A router's port takes several bridges; a serial port, or one that is listened on, a single one.
            shared = connection.startswith(SHARED_LINKS)
            system = link.get("system", -number)
            # Ports of one computer are not those of another.
            is_local = not shared or bool(_LOOPBACK.fullmatch(connection.split(":", 1)[1].rpartition(":")[0]))
            others = known.setdefault((connection, row.get("host") if is_local else None), [])
            for other, its_system in others:
                if not shared or None in (system, its_system) or system == its_system:
                    way = "a link, or a system on it," if shared else "a link"
                    reader.add(
                        place,
                        f"robot[{other}] has {show(connection)} already: each robot needs {way} of its own",
                    )
                    break
            others.append((number, system))


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
