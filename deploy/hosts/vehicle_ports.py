"""What is wrong with the serial ports of vehicles, as `handfast up` finds it on each host before it starts
anything: only looked at, for the bridge that has a port has it alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.mavlink_section import MavlinkSection
from handfast.agent.fleet.model import Fleet
from handfast.deploy.hosts import remote_vehicle
from handfast.deploy.hosts.connection import HostConnection, HostError
from handfast.deploy.inventory.hosts import robots_on

TEXT_MAX: Final = 200


def port_warnings(connection: HostConnection, fleet: Fleet) -> list[str]:
    """Sentences, one for each thing that is wrong with a robot's port on that host.

    Raises:
        HostError: the host does not answer.
    """
    wanted = {}
    for robot in robots_on(fleet, connection.host):
        section = fleet.robot(robot).section(MavlinkSection)
        if section is not None and (section.connection or "").startswith("/dev/"):
            wanted[robot] = str(section.connection)
    if not wanted:
        return []
    connection.extend(remote_vehicle)
    found = connection.ask("ports", paths=sorted(set(wanted.values())))
    user = printable(str(connection.about["user"]))
    try:
        return [
            f"robot {robot}: {path}: {text}"
            for robot, path in wanted.items()
            for text in _sentences(found[path], user)
        ]
    except (LookupError, TypeError, AttributeError):
        raise HostError("what it says of its serial ports makes no sense") from None


def _sentences(found: Mapping[str, Any], user: str) -> Iterator[str]:
    """What to say of one port (`deploy.hosts.remote_vehicle.port`)."""

    def said(what: str) -> str:
        return printable(str(found[what])[:TEXT_MAX])

    if "there" in found:
        others = [printable(str(each)[:TEXT_MAX]) for each in found["there"]]
        instead = (
            f"there {'are' if len(others) > 1 else 'is'} {', '.join(others)}" if others else "nor any other"
        )
        yield (
            f"is not there, {instead}: connect it, or correct mavlink.connection (a UART of a Raspberry Pi: "
            "enable_uart=1 in config.txt); its bridge waits for it"
        )
    if "kind" in found:
        yield f"is {said('kind')}, no serial port: correct mavlink.connection"
    if found.get("denied"):
        group = said("denied")
        yield (
            f"is for the group {group}, and {user} is not in it: sudo usermod -aG {group} {user} there, then "
            "restart that computer"
        )
    elif "denied" in found:
        yield (
            "is for its owner alone, as a port is that a console has: take that off it, or write a rule of "
            'udev\'s there (GROUP="dialout", MODE="0660")'
        )
    if "late" in found:
        yield (
            f"{user} is in the group {said('late')}, but was not when its systemd began there: restart that "
            "computer"
        )
    if "console" in found:
        yield (
            f"{said('console')} is on it, and would speak to the vehicle: take console=... out of the "
            "kernel's command line there and sudo systemctl disable --now serial-getty@... (a Raspberry Pi: "
            "raspi-config, serial port: no login shell, hardware on), then restart that computer"
        )
    if "modem" in found:
        yield (
            "ModemManager runs there, and speaks to what is on a USB port to see whether it is a modem: sudo "
            "systemctl disable --now ModemManager"
        )
