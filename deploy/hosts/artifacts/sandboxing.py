"""What a robot's process is kept from on its computer, as settings of its systemd user unit (PURE).

Two parts. What the kernel refuses by filters of system calls works for every user. What needs namespaces of
the process's own does not work on every kernel and distribution: it stands between `TRIED` and `UNTIL`, and
`deploy.hosts.remote_program` tries it on the robot's computer and leaves it out where it does not work.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

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
        realtime: asks for SCHED_FIFO (`agent.runtime.realtime`).
    """

    writes: Sequence[str] = ()
    devices: bool = False
    others_code: bool = False
    others_hardware: bool = False
    realtime: bool = False


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
    if not needs.realtime:
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
