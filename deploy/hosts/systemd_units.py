"""The systemd user units of robots and routers, one for each process, with their sandboxes (PURE).

A unit owns its process: it starts it again when it dies, and when its loop does not say for a while that it
lives (`agent.runtime.service`), and it bounds what the process may take. Neither ssh nor the
operator's machine is needed for that.

The sandbox has two parts. What the kernel refuses by filters of system calls works for every user. What needs
namespaces of the process's own does not work on every kernel and distribution: it stands between `TRIED` and
`UNTIL`, and `deploy.hosts.remote_program` tries it on the robot's computer and leaves it out where it does
not work.

A bridge's unit does not wait for its serial port: the bridge does, and says on the bus for what. A unit after
a device's says nothing meanwhile, and starts 90 s late where no udev tells the user's systemd of the port.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from handfast.agent.common.errors import BAD_INPUT
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.security.identity import of_robot, of_router
from handfast.deploy.processes.child import ONE_THREAD

TRIED: Final = "# sandbox: tried on this computer, left out where it does not work"
UNTIL: Final = "# sandbox: until here"
"""As `deploy.hosts.remote_program` finds them."""
BRIDGE_STATE: Final = ".local/state/handfast"
"""Below the home: where a bridge keeps how far it has counted what it signs (`bridges.mavlink.session`)."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What one process needs beyond reading files and speaking to the network.

    Attributes:
        writes: folders that it writes to, absolute, or below the home with ``~/``.
        devices: drives a body that is real: it opens devices, and is found by others in the shared ``/tmp``,
            where a connection is locked (`bridges.mavlink.transport.transport`).
        others_code: runs a plugin: nobody knows what that needs of memory.
        others_hardware: runs a plant of others, which may be on a bus of another kind, or in ``/sys``.
    """

    writes: Sequence[str] = ()
    devices: bool = False
    others_code: bool = False
    others_hardware: bool = False


def filters(needs: Needs) -> Iterator[str]:
    """Settings that work for every user: filters of system calls."""
    yield "NoNewPrivileges=yes"
    yield "SystemCallArchitectures=native"
    yield "SystemCallFilter=@system-service"
    yield "SystemCallErrorNumber=EPERM"  # a library that only tries something goes on without it
    families = ["AF_INET", "AF_INET6", "AF_UNIX", "AF_NETLINK"]
    families += ["AF_CAN", "AF_BLUETOOTH"] if needs.others_hardware else []
    yield f"RestrictAddressFamilies={' '.join(families)}"
    yield "RestrictNamespaces=yes"
    yield "RestrictRealtime=yes"
    yield "RestrictSUIDSGID=yes"
    yield "LockPersonality=yes"
    yield "KeyringMode=private"
    if not needs.others_code:  # compilers of numbers, as numba's, write what they run
        yield "MemoryDenyWriteExecute=yes"


def namespaces(needs: Needs) -> Iterator[str]:
    """Settings that need namespaces, with the lines around them."""
    yield TRIED
    yield "PrivateUsers=yes"  # the one namespace that a user may make, in which the others can be made
    yield "CapabilityBoundingSet="
    yield "ProtectSystem=strict"
    yield "ProtectHome=read-only"
    yield "ProtectControlGroups=yes"
    if not needs.others_hardware:
        yield "ProtectKernelTunables=yes"
    if not (needs.devices or needs.others_hardware):
        yield "PrivateDevices=yes"
    writes = [
        folder.replace("~/", "%h/", 1) if folder[0] == "~" else _path(folder) for folder in needs.writes
    ]
    if needs.devices:
        writes.append("/tmp")
    else:
        yield "PrivateTmp=yes"
    # "-": a folder that somebody has removed must not keep a robot from starting.
    yield f"ReadWritePaths={' '.join(map(_optional, writes))}"
    yield "InaccessiblePaths=-%h/.ssh -%h/.gnupg -%h/.config/handfast/keys"
    # There the user's systemd and its bus are to be had, which would start anything outside all this.
    yield "TemporaryFileSystem=%t:ro"
    yield "BindReadOnlyPaths=%t/systemd/notify"
    yield UNTIL


def _path(path: str) -> str:
    """An absolute path as systemd reads it in a list: it expands %."""
    return path.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")


def _optional(path: str) -> str:
    """An entry of a list of paths that need not be there."""
    return f'"-{path}"' if any(c in path for c in " \t'\"\\;") else f"-{path}"


RECORDER: Final = "recorder"
RECORDER_MODULE: Final = "handfast.agent.recorder"
ROUTER: Final = "router"
ROUTER_MODULE: Final = "handfast.agent.runtime.router"
WATCHDOG_S: Final = {"agent": 1.5, "plant": 1.5, RECORDER: 90.0, ROUTER: 3.0}
"""A process whose loop is silent for so long is killed and started again. A recorder's disk may stall; a
router is every robot's, and its loop is not what passes messages on."""
RESTART_DELAY_MS: Final = 200
STOP_TIMEOUT_S: Final = 5
"""A process that was asked to end brakes first; after this it is killed."""
START_TIMEOUT_S: Final = 60
MEMORY_MAX_MB: Final = 1024
TASKS_MAX: Final = 128
FILES_MAX: Final = 8192
"""Anybody in the network can open connections: the usual 1024 would soon be used up."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where things are on a robot's computer; absolute paths.

    Attributes:
        version: folder of the installed version, with its own Python in ``bin/python``.
        fleet_file: what the processes read.
        keys: folder of private keys and certificates, None in a fleet that is not secured.
        recordings: folder of what robots record.
        state: folder of what processes remember while the fleet is up.
        orders: folder of operators' orders, which outlive processes and `handfast down`.
    """

    version: str
    fleet_file: str
    keys: str | None
    recordings: str
    state: str
    orders: str


def fleet_file(fleet: Fleet, text: str) -> str:
    """Place of the fleet file within our folder there; another text has another one, so units change."""
    return f"fleets/{fleet.fleet.name}/fleet-{hashlib.sha256(text.encode()).hexdigest()[:8]}.toml"


def places(fleet: Fleet, root: str, version: str, text: str) -> Places:
    """All places that units name.

    Args:
        root: our folder there.
        version: what is installed there.
        text: of the fleet file that robots read.
    """
    base = f"{root}/fleets/{fleet.fleet.name}"
    return Places(
        version=f"{root}/versions/{version}",
        fleet_file=f"{root}/{fleet_file(fleet, text)}",
        keys=f"{base}/keys" if fleet.is_secured else None,
        recordings=f"{base}/recordings",
        state=f"{base}/state",
        orders=f"{base}/orders",
    )


def roles(fleet: Fleet) -> tuple[str, ...]:
    """Processes that each robot has, in the order of their start."""
    return ("plant", "agent", RECORDER) if fleet.recording.max_mb else ("plant", "agent")


def unit_name(fleet: str, robot: int, role: str) -> str:
    """Name of the systemd unit of a robot's process."""
    return f"handfast-{fleet}-robot-{robot}-{role}.service"


def router_unit_name(fleet: str) -> str:
    """Name of the systemd unit of a router: a host has one at most."""
    return f"handfast-{fleet}-router.service"


def identifier(unit: str) -> str:
    """What lines of a unit's log in the journal begin with."""
    return unit.removesuffix(".service")


def arguments(fleet: Fleet, robot: int, role: str, places: Places) -> list[str]:
    """The command line of a process."""
    kind = fleet.robot(robot).kind
    module = {"agent": "handfast.agent", "plant": kind.program, RECORDER: RECORDER_MODULE}[role]
    words = [f"{places.version}/bin/python", "-P", "-m", module]
    words += ["--fleet", places.fleet_file, "--robot", str(robot)]
    if places.keys is not None:
        words += ["--keys", places.keys]
    if role in ROLES:
        words += ["--orders", places.orders]
    if role == "plant" and not kind.vehicle:
        words += ["--pose-file", f"{places.state}/robot-{robot}.pose"]
    if role == RECORDER:
        words += ["--folder", f"{places.recordings}/robot-{robot}"]
    return words


def unit(fleet: Fleet, robot: int, role: str, places: Places) -> str:
    """Text of a process's unit file."""
    name, reads = fleet.fleet.name, []
    if places.keys is not None:  # with another authority it gets another one as well
        reads.append(f"{places.keys}/{of_robot(name, robot).common_name}.crt")
    words, needs = arguments(fleet, robot, role, places), _needs(fleet, robot, role, places)
    unit = unit_name(name, robot, role)
    return "\n".join(_lines(unit, f"{name}: robot {robot}'s {role}", role, words, reads, needs))


def units(fleet: Fleet, robot: int, places: Places) -> dict[str, str]:
    """Texts of all unit files of a robot, by name."""
    return {
        unit_name(fleet.fleet.name, robot, role): unit(fleet, robot, role, places) for role in roles(fleet)
    }


def router_units(fleet: Fleet, host: HostSection, places: Places) -> dict[str, str]:
    """Text of the unit file of the router on a host, by name; empty where there is none."""
    router = fleet.router_on(host.name)
    if router is None:
        return {}
    name, keys, reads = fleet.fleet.name, places.keys, []
    words = [f"{places.version}/bin/python", "-P", "-m", ROUTER_MODULE, "--fleet", places.fleet_file]
    words += ["--number", str(router.number)]
    if keys is not None:
        words += ["--keys", keys]
        reads.append(f"{keys}/{of_router(name, router.identity_name).common_name}.crt")
    unit = router_unit_name(name)
    return {unit: "\n".join(_lines(unit, f"{name}: router {router.number}", ROUTER, words, reads, Needs()))}


def _needs(fleet: Fleet, robot: int, role: str, places: Places) -> Needs:
    kind = fleet.robot(robot).kind
    if role == RECORDER:
        return Needs([f"{places.recordings}/robot-{robot}"])
    if role == "agent":
        return Needs([places.orders], others_code=fleet.control.law is not None)
    return Needs(
        [places.orders, f"~/{BRIDGE_STATE}" if kind.vehicle else places.state],
        devices=kind.vehicle,
        others_code=kind.is_plugin,
        others_hardware=kind.is_plugin,
    )


def _lines(
    unit: str,
    about: str,
    role: str,
    words: Sequence[str],
    reads: Sequence[str],
    needs: Needs,
) -> Iterator[str]:
    # deploy.hosts.remote_program reads this again: it tells whether what runs is what is meant, and has read
    # what is there; which folders there must be.
    yield "# Written by `handfast up`: changed there, or removed by `handfast down`."
    yield f"# runs: {json.dumps(words)}"
    yield f"# reads: {json.dumps(reads)}"
    yield f"# writes: {json.dumps(list(needs.writes))}"
    yield "[Unit]"
    yield f"Description=handfast {about}"
    yield "StartLimitIntervalSec=0"  # it has to come back, however often it fell
    yield ""
    yield "[Service]"
    yield "Type=notify"
    yield f"ExecStart={' '.join(map(_quoted, words))}"
    for key, value in ONE_THREAD.items():
        yield f"Environment={key}={value}"
    yield "Environment=PYTHONUNBUFFERED=1"
    yield "Restart=always"
    # A process that would fail again in the same way is not started again.
    yield f"RestartPreventExitStatus={BAD_INPUT}"
    yield f"RestartSec={RESTART_DELAY_MS}ms"
    yield f"WatchdogSec={WATCHDOG_S[role]:g}"
    yield "WatchdogSignal=SIGKILL"  # a frozen process hears no other
    yield f"TimeoutStartSec={START_TIMEOUT_S}"
    yield f"TimeoutStopSec={STOP_TIMEOUT_S}"
    yield f"MemoryMax={MEMORY_MAX_MB}M"
    yield f"TasksMax={TASKS_MAX}"
    yield f"LimitNOFILE={FILES_MAX}"
    yield "LimitCORE=0"
    yield "OOMPolicy=stop"
    yield "UMask=0077"
    yield f"SyslogIdentifier={identifier(unit)}"
    yield from filters(needs)
    yield from namespaces(needs)
    yield ""


def _quoted(word: str) -> str:
    """A word of ExecStart: systemd expands % and $, and splits at spaces."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if any(c in word for c in " \t'\"\\;") else escaped
