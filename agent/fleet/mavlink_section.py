"""The table of a robot that is a vehicle reached by MAVLink, and what can be wrong in it (PURE)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import setting
from handfast.agent.common.wording import show

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
