"""Makes one host ready for its robots and its router.

It looks at the host and at the serial ports of its vehicles, installs, writes the fleet file, finds what is
to start, and starts the router. A serial port is only looked at: the bridge that has it has it alone.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple, Protocol

from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.plants import MavlinkSection
from handfast.agent.fleet.sections import CLOCK_SKEW_MAX_S
from handfast.deploy.hosts import systemd_units
from handfast.deploy.hosts.bundle import Bundle, BundleError, Platform, bundle_for
from handfast.deploy.hosts.connection import Clock, HostConnection, HostError
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
    """What to say of one port (`deploy.hosts.remote_program.port`)."""

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


INSTALL_TIMEOUT_S: Final = 400.0
INSTALL_BYTES: Final = 500_000_000
"""Wheels and what is installed from them; a host with less is full."""
CLOCK_ERROR_MAX_S: Final = 1.0
"""Orders and certificates of a host whose clock is further off make no sense there."""

Say = Callable[[str], None]
"""Called with what is being done, in a few words."""


class Keys(Protocol):
    """Gives who is on a host their certificates, see `deploy.hosts.certificates.HostKeys`."""

    def __call__(
        self, connection: HostConnection, version: str, folder: str, *, robots: bool = True
    ) -> None: ...


class Prepared(NamedTuple):
    """A host that is ready.

    Attributes:
        version: what is installed there.
        units: texts of the robots' units, by robot and name.
        stale: by robot, its units that do not run yet, or run something else than they should; none of
            robots whose units are all well. Their files are as they were.
        router: texts of the units of its router, by name; none where it has none.
        stale_router: those of them that do not run yet, or run something else than they should.
        unwanted: units that should not be there.
        warnings: what its operator should know.
    """

    version: str
    units: Mapping[int, Mapping[str, str]]
    stale: Mapping[int, tuple[str, ...]]
    router: Mapping[str, str]
    stale_router: tuple[str, ...]
    unwanted: tuple[str, ...]
    warnings: tuple[str, ...]


def prepare(
    connection: HostConnection,
    fleet: Fleet,
    text: str,
    program: bytes,
    say: Say,
    keys: Keys | None,
    before_changes: Callable[[], None],
    *,
    robots: bool = True,
) -> Prepared:
    """Makes a host ready; what is ready already is left alone.

    Args:
        fleet: resolved and located.
        text: of the fleet file that robots read.
        program: `deploy.hosts.bundle.program_archive`.
        keys: gives robots and routers of a secured fleet their certificates.
        before_changes: called when all is there, before the robots' files and units change; may raise.
        robots: False for the router alone: its robots and their units are left as they are.

    Raises:
        HostError: it cannot be made ready; the text says why.
    """
    about = connection.about
    say("checking")
    _refuse(connection.host, about)
    clock = connection.clock()
    warnings = list(_clock_warnings(fleet, clock))
    if robots:
        warnings += port_warnings(connection, fleet)
    try:
        platform = Platform.of(about)
        say("collecting wheels")
        bundle = bundle_for(platform, program)
    except BundleError as error:
        raise HostError(str(error)) from None
    if not connection.ask("installed", version=bundle.version):
        install(connection, bundle, say)
    file = systemd_units.fleet_file(fleet, text)
    places = systemd_units.places(fleet, about["root"], bundle.version, text)
    before_changes()
    say("configuring")
    digests = {file: hashlib.sha256(text.encode()).hexdigest()}
    if connection.ask("missing", paths=digests):
        connection.exchange("put", text.encode(), path=file)
    if places.keys is not None and keys is not None:
        say("certificates")
        keys(connection, bundle.version, places.keys, robots=robots)
    say("comparing")
    prepared = _compared(connection, fleet, places, bundle.version, robots=robots)
    return prepared._replace(warnings=(*warnings, *prepared.warnings))


def _compared(
    connection: HostConnection,
    fleet: Fleet,
    places: systemd_units.Places,
    version: str,
    *,
    robots: bool,
) -> Prepared:
    """Compare the units of a host with those that it should have. Files are written only of those that run as
    they should: what a crash would start is the same."""
    host, about = connection.host, connection.about
    router = systemd_units.router_units(fleet, host, places)
    ids = robots_on(fleet, host) if robots else ()
    texts = {robot: systemd_units.units(fleet, robot, places) for robot in ids}
    wanted = {unit: text for of_robot in texts.values() for unit, text in of_robot.items()} | router
    found = connection.ask("compare", fleet=fleet.fleet.name, wanted=wanted)
    every = {robot: tuple(unit for unit in texts[robot] if unit in found["stale"]) for robot in ids}
    stale = {robot: units for robot, units in every.items() if units}
    stale_router = tuple(unit for unit in router if unit in found["stale"])
    fine = {} if stale_router else dict(router)
    for robot in ids:
        if robot not in stale:
            fine |= texts[robot]
    if not fine.keys().isdisjoint(found["unwritten"]):
        connection.ask("units", wanted=fine)
    unwanted = tuple(found["unwanted"]) if robots else ()
    return Prepared(version, texts, stale, router, stale_router, unwanted, _limits(found, about))


def _limits(found: Mapping[str, Any], about: Mapping[str, Any]) -> tuple[str, ...]:
    """Return warnings of what a host does not offer, though robots can be driven there."""
    warnings = []
    if found["open"]:
        warnings.append(
            "its units' processes see and write whatever its user can, as users have no namespaces there (on "
            "Ubuntu: sysctl kernel.apparmor_restrict_unprivileged_userns); all else that closes them is on"
        )
    if not about["journal"]:
        warnings.append(
            f"{about['user']} may not read its journal, `handfast logs` shows nothing of it: "
            f"sudo usermod -aG systemd-journal {about['user']}"
        )
    return tuple(warnings)


def _refuse(host: HostSection, about: Mapping[str, Any]) -> None:
    user = about["user"]
    if not about["writable"]:
        raise HostError(f"{user} may not write to {about['root']} there")
    if not about["systemd"]:
        raise HostError(
            f"no systemd answers {user} there: robots' processes are its user units. Debian, Ubuntu: sudo "
            f"apt install systemd dbus-user-session, sudo loginctl enable-linger {user}, then log in anew"
        )
    if not about["lingers"]:
        raise HostError(
            f"the processes of {user} would end with the last login: sudo loginctl enable-linger {user} there"
        )


def _clock_warnings(fleet: Fleet, clock: Clock) -> list[str]:
    off_s = abs(clock.offset_s)
    way = f"its clock is {off_s:.2f} s {'ahead of' if clock.offset_s > 0 else 'behind'} this machine's"
    if off_s > CLOCK_ERROR_MAX_S + clock.error_s:
        raise HostError(f"{way}: set it first, by chrony or systemd-timesyncd (timedatectl)")
    if off_s > CLOCK_SKEW_MAX_S + clock.error_s:
        return [f"{way}, more than {CLOCK_SKEW_MAX_S:g} s: set it by chrony or systemd-timesyncd"]
    return []


def install(connection: HostConnection, bundle: Bundle, say: Say) -> None:
    """Installs a bundle, sending only what is not there yet; raises `HostError`."""
    free = connection.about["free_bytes"]
    if free < INSTALL_BYTES:
        raise HostError(
            f"the disk is full: {free / 1e6:.0f} MB are free in {connection.about['root']}, "
            f"{INSTALL_BYTES / 1e6:.0f} MB are needed"
        )
    files = {f"wheels/{name}": digest for name, digest in bundle.wheels.items()}
    program = f"wheels/{bundle.program_name}"
    lacking = connection.ask("missing", paths=files | {program: hashlib.sha256(bundle.program).hexdigest()})
    sizes = {path: (bundle.folder / path.removeprefix("wheels/")).stat().st_size for path in files}
    total = sum(sizes.get(path, len(bundle.program)) for path in lacking)
    sent = 0
    for path in lacking:
        say(f"sending {sent / 1e6:.0f} of {total / 1e6:.0f} MB")
        data = (
            bundle.program if path == program else (bundle.folder / path.removeprefix("wheels/")).read_bytes()
        )
        connection.exchange("put", data, path=path, timeout_s=INSTALL_TIMEOUT_S)
        sent += len(data)
    say("installing")
    connection.ask(
        "install",
        version=bundle.version,
        wheels=[path for path in files if path != f"wheels/{bundle.pip}"],
        pip=f"wheels/{bundle.pip}",
        program=program,
        timeout_s=INSTALL_TIMEOUT_S,
    )


LOOK_S: Final = 0.2


def start_router(
    connection: HostConnection,
    fleet: str,
    prepared: Prepared,
    timeout_s: float,
    ended: Callable[[], bool],
) -> None:
    """Has those units of a host's router start that do not run as they should; waits until all of them do.

    Args:
        fleet: its name.
        ended: whether nobody waits for it any more.

    Raises:
        HostError: one does not run; the text says what its process said last.
    """
    names = prepared.stale_router
    if not names:
        return
    before = _processes(connection, fleet)
    connection.ask("units", wanted=prepared.router)
    connection.ask("restart", names=names)
    deadline = time.monotonic() + timeout_s
    while True:
        # A unit that was asked to start again may be seen as it was: another process tells that it has.
        now = _processes(connection, fleet)
        lacking = [name for name in names if not _is_new(now.get(name, {}), before.get(name, {}))]
        if not lacking:
            return
        failed = [name for name in lacking if now.get(name, {}).get("ActiveState") == "failed"]
        if failed or ended() or time.monotonic() > deadline:
            break
        time.sleep(LOOK_S)
    name = (failed or lacking)[0]
    lines = connection.ask("last_lines", name=name, count=1)
    state = connection.ask("states", names=[name])[name]
    raise HostError(f"its router is {state}{f': {lines[-1]}' if lines else ''}")


def _processes(connection: HostConnection, fleet: str) -> Mapping[str, Mapping[str, Any]]:
    found: Mapping[str, Mapping[str, Any]] = connection.ask("status", fleet=fleet)["units"]
    return found


def _is_new(about: Mapping[str, Any], before: Mapping[str, Any]) -> bool:
    return about.get("ActiveState") == "active" and about.get("MainPID") != before.get("MainPID", "0")
