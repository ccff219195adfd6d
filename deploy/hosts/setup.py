"""Makes one host ready for its robots and its router: looks at it, installs, writes the fleet file, what is
to start."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, Protocol

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.sections import CLOCK_SKEW_MAX_S
from handfast.deploy.hosts.artifacts import systemd_units
from handfast.deploy.hosts.artifacts.bundle import Bundle, BundleError, Platform, bundle_for
from handfast.deploy.hosts.connection import Clock, HostConnection, HostError
from handfast.deploy.hosts.vehicle_ports import port_warnings
from handfast.deploy.inventory.hosts import robots_on

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
        program: `deploy.hosts.artifacts.bundle.program_archive`.
        keys: gives robots and routers of a secured fleet their certificates.
        before_changes: called when all is there, before the robots' files and units change; may raise.
        robots: False for the router alone: its robots and their units are left as they are.

    Raises:
        HostError: it cannot be made ready; the text says why.
    """
    host, about = connection.host, connection.about
    say("checking")
    _refuse(host, about)
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
    name = fleet.fleet.name
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
    router = systemd_units.router_units(fleet, host, places)
    texts = {
        robot: systemd_units.units(fleet, robot, places)
        for robot in (robots_on(fleet, host) if robots else ())
    }
    say("comparing")
    wanted = {unit: text for of_robot in texts.values() for unit, text in of_robot.items()} | router
    found = connection.ask("compare", fleet=name, wanted=wanted)
    stale = {
        robot: tuple(unit for unit in of_robot if unit in found["stale"])
        for robot, of_robot in texts.items()
        if not of_robot.keys().isdisjoint(found["stale"])
    }
    stale_router = tuple(unit for unit in router if unit in found["stale"])
    # Files of those that run as they should: what a crash would start is the same.
    fine = {
        unit: text
        for robot, of_robot in texts.items()
        if robot not in stale
        for unit, text in of_robot.items()
    } | (router if not stale_router else {})
    if not fine.keys().isdisjoint(found["unwritten"]):
        connection.ask("units", wanted=fine)
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
    return Prepared(
        bundle.version,
        texts,
        stale,
        router,
        stale_router,
        tuple(found["unwanted"]) if robots else (),
        tuple(warnings),
    )


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
