"""A fleet as a folder for Ansible, which brings it up on its hosts as `handfast up` does: its texts.

What is the same for every fleet lies in ``deployment/``: a playbook, whose tasks have the host's part of
`handfast up` (`deploy.hosts.remote_program`) decide. What a fleet adds is here: who and where its hosts are,
what to bring them, and what their units are.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from agent.fleet.hosts import HostSection
from agent.fleet.model import Fleet
from agent.security.credentials import ANOTHER_AUTHORITY
from agent.supervision.state_machine import DRIVING
from deploy.console.data_files import ANSIBLE
from deploy.hosts import remote_program
from deploy.hosts.artifacts import systemd_units
from deploy.hosts.artifacts.bundle import Bundle, Platform
from deploy.hosts.artifacts.systemd_units import fleet_file, places
from deploy.hosts.certificates import MODULE, REQUEST_BYTES_MAX, identities_on, naming
from deploy.hosts.connection import NO_PYTHON, PROGRAM, bootstrap
from deploy.hosts.setup import CLOCK_ERROR_MAX_S, INSTALL_BYTES
from deploy.inventory.hosts import hosts_of, robots_on
from deploy.inventory.ssh import ALIVE_COUNT, ALIVE_INTERVAL_S, CONNECT_TIMEOUT_S

GROUP: Final = "handfast_robots"
OPERATORS_FLEET: Final = "fleet.toml"
ROOT: Final = "{{handfast_root}}"
VERSION: Final = "{{handfast_version}}"
_PLATFORM: Final = re.compile(r"3\.(\d{1,2}) ([a-z0-9_]{1,20}) (?:glibc2\.(\d{1,2})|musl)", re.ASCII)
PLATFORM_SAYS: Final = (
    'Python, processor and C library of a host, such as "3.11 aarch64 glibc2.36" or "3.12 x86_64 musl"'
)
_BATCH: Final = re.compile(r"([1-9][0-9]{0,5})|(?:100|[1-9][0-9]?)%", re.ASCII)
ALL_AT_ONCE: Final = ("100%",)
CANARIES: Final = (1, "10%", "100%")
FEW: Final = 20
"""So many hosts are brought up at once unless it is said otherwise; more begin with a canary."""
FAIL_PERCENTAGE: Final = 30

Batch = int | str
"""Of hosts: how many, or a percentage of all."""


class DeploymentError(ValueError):
    """A fleet that cannot be written as a folder for Ansible; the text is one clear line."""


@dataclass(frozen=True, slots=True)
class Batches:
    """How many hosts are brought up at a time, as Ansible's ``serial`` and ``max_fail_percentage``.

    Attributes:
        serial: the batches in turn; the last one again and again for the hosts that are left.
        max_fail_percentage: when more than these fail of a batch, the ones after it are left alone.
    """

    serial: tuple[Batch, ...]
    max_fail_percentage: int


def parse_batches(serial: Sequence[str], max_fail_percentage: int | None, hosts: int) -> Batches:
    """Reads batches from options' texts, each with one or several; what is not given is by how many hosts
    there are.

    Raises:
        DeploymentError: these are none.
    """
    found: list[Batch] = []
    for text in serial:
        words = text.replace(",", " ").split()
        for word in words or [text]:
            match = _BATCH.fullmatch(word)
            if match is None:
                raise DeploymentError(
                    f"--serial {word!r} is no batch: give a number of hosts or 1% to 100%, such as "
                    "--serial 1 --serial 10% --serial 50%"
                )
            found.append(int(word) if match[1] else word)
    batches = tuple(found) or (CANARIES if hosts > FEW else ALL_AT_ONCE)
    if max_fail_percentage is None:
        max_fail_percentage = 100 if batches == ALL_AT_ONCE else FAIL_PERCENTAGE
    if not 0 <= max_fail_percentage <= 100:
        raise DeploymentError(f"--max-fail-percentage must be from 0 to 100, got {max_fail_percentage}")
    return Batches(batches, max_fail_percentage)


@dataclass(frozen=True, slots=True)
class Pack:
    """What is installed on hosts of one platform."""

    platform: Platform
    bundle: Bundle


def parse_platform(text: str) -> Platform:
    """Reads a platform from an option's text (`PLATFORM_SAYS`).

    Raises:
        DeploymentError: it is none, or one that handfast does not run on.
    """
    found = _PLATFORM.fullmatch(" ".join(text.split()))
    if found is None:
        raise DeploymentError(f"{text!r} is no platform: give {PLATFORM_SAYS}")
    minor, machine, glibc = found.groups()
    if int(minor) < 11:
        raise DeploymentError(f"{text!r}: robots need Python 3.11 or later")
    return Platform((3, int(minor)), machine, ("glibc", f"2.{glibc}") if glibc else ("", ""))


def texts(
    fleet: Fleet,
    source: str,
    robots_text: str,
    operators_text: str,
    packs: Sequence[Pack],
    batches: Batches,
) -> dict[str, str]:
    """All files of the folder but wheels and our packages, by their path in it.

    Args:
        fleet: resolved and located.
        source: the fleet file's name, for messages.
        robots_text: of the fleet file that robots read.
        operators_text: of the one that the operator's commands read.
        packs: for all platforms of the hosts.
        batches: in which hosts are brought up.

    Raises:
        FleetError: the fleet is not for several machines.
        DeploymentError: a field has what Ansible would read as something else.
    """
    hosts = hosts_of(fleet, source)
    same = {
        path.relative_to(ANSIBLE).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(ANSIBLE.rglob("*"))
        if path.is_file()
    }
    readme = same.pop("README.md")
    for mark, text in (
        ("@NAME@", fleet.fleet.name),
        ("@KEYS@", f"handfast keys {OPERATORS_FLEET}               # once: the fleet's authority\n    "),
        ("@PLATFORMS@", "; ".join(str(pack.platform) for pack in packs)),
        ("@BATCHES@", in_words(batches)),
    ):
        readme = readme.replace(mark, text if fleet.is_secured or mark != "@KEYS@" else "")
    inventory: dict[str, Any] = {"all": {"children": {GROUP: {"hosts": {host.name: {} for host in hosts}}}}}
    return {
        **same,
        "README.md": readme,
        OPERATORS_FLEET: operators_text,
        "files/robots-fleet.toml": robots_text,
        "files/host_program.py": PROGRAM.read_text(encoding="utf-8"),
        "inventory.json": _json(inventory),
        "batches.json": _json(
            {
                "handfast_serial": batches.serial,
                "handfast_max_fail_percentage": batches.max_fail_percentage,
            }
        ),
        f"group_vars/{GROUP}.json": _json(_of_all(fleet, robots_text, packs)),
        **{f"host_vars/{host.name}.json": _json(_of_one(fleet, host, robots_text)) for host in hosts},
    }


def in_words(batches: Batches) -> str:
    """How hosts are brought up, for people."""
    if batches.serial == ALL_AT_ONCE and batches.max_fail_percentage == 100:
        return "all hosts at once"
    first, *others = (f"{each}" if isinstance(each, str) else _hosts(each) for each in batches.serial)
    then = "".join(f", then {each}" for each in others)
    limit = f"{batches.max_fail_percentage}%"
    return f"hosts in batches ({first}{then}), which end where more than {limit} of one fail"


def _hosts(count: int) -> str:
    return f"{count} host{'s' * (count != 1)}"


def _of_all(fleet: Fleet, robots_text: str, packs: Sequence[Pack]) -> dict[str, Any]:
    return {
        "ansible_python_interpreter": "auto_silent",
        "handfast_command": ["handfast"],
        "handfast_fleet": fleet.fleet.name,
        "handfast_secured": fleet.is_secured,
        "handfast_fleet_path": fleet_file(fleet, robots_text),
        "handfast_program_bytes": PROGRAM.stat().st_size,
        "handfast_greeting": remote_program.GREETING.decode("ascii").strip(),
        "handfast_no_python": NO_PYTHON,
        "handfast_bundles": [_bundle(pack) for pack in packs],
        "handfast_install_bytes": INSTALL_BYTES,
        "handfast_clock_error_max_s": CLOCK_ERROR_MAX_S,
        "handfast_another_authority": ANOTHER_AUTHORITY,
        "handfast_request_bytes_max": REQUEST_BYTES_MAX,
        # What systemd shows of an agent that drives: its state, and why.
        "handfast_drives": f"({'|'.join(sorted(state.value for state in DRIVING))})(:|$)",
    }


def _bundle(pack: Pack) -> dict[str, Any]:
    platform, bundle = pack.platform, pack.bundle
    wheels = {f"wheels/{name}": digest for name, digest in bundle.wheels.items()}
    pip, program = f"wheels/{bundle.pip}", f"wheels/{bundle.program_name}"
    return {
        "python": f"{platform.python[0]}.{platform.python[1]}",
        "machine": platform.machine,
        "libc": platform.libc[0],
        "libc_minor": int(platform.libc[1].partition(".")[2] or 0),
        "version": bundle.version,
        "files": wheels | {program: hashlib.sha256(bundle.program).hexdigest()},
        "install": {
            "do": "install",
            "version": bundle.version,
            "wheels": [path for path in wheels if path != pip],
            "pip": pip,
            "program": program,
        },
    }


def _of_one(fleet: Fleet, host: HostSection, robots_text: str) -> dict[str, Any]:
    if host.key is not None and re.search(r"\{[{%#]", host.key):
        raise DeploymentError(f"host.{host.name}.key: Ansible would read {host.key!r} as a template")
    there = places(fleet, ROOT, VERSION, robots_text)
    robots = robots_on(fleet, host)
    address = host.address or host.name
    variables: dict[str, Any] = {
        **_reached(host),
        "handfast_bootstrap": bootstrap(host.python),
        "handfast_robots": list(map(str, robots)),
        "handfast_units": {str(robot): systemd_units.units(fleet, robot, there) for robot in robots},
        "handfast_router_units": systemd_units.router_units(fleet, host, there),
    }
    if fleet.is_secured:
        identities = identities_on(fleet, host)
        who = {
            asks: ["--folder", f"{there.keys}", "--fleet", fleet.fleet.name, *naming(identity)]
            for asks, identity in identities.items()
        }
        variables["handfast_certified"] = list(identities)
        variables["handfast_certificate_requests"] = [
            _run(["request", *words, "--addresses", address, "--ca", "-"], "{{handfast_signed.authority}}")
            for words in who.values()
        ]
        variables["handfast_certificate_answers"] = [
            _run(["store", *words], f"{{{{handfast_signed.signed['{asks}'] | default('')}}}}")
            for asks, words in who.items()
        ]
    return variables


def _run(arguments: Sequence[str], text: str) -> dict[str, Any]:
    return {"do": "run", "module": MODULE, "arguments": list(arguments), "version": VERSION, "text": text}


def _reached(host: HostSection) -> Mapping[str, Any]:
    """How Ansible reaches a host: as `deploy.inventory.ssh` does, by its name in ssh's own configuration."""
    options = ["-o", "BatchMode=yes", "-o", f"ConnectTimeout={CONNECT_TIMEOUT_S}"]
    # Else a connection that Ansible keeps, to a host that is gone by now, has it wait for minutes.
    options += ["-o", f"ServerAliveInterval={ALIVE_INTERVAL_S}", "-o", f"ServerAliveCountMax={ALIVE_COUNT}"]
    if host.address is not None:
        options += ["-o", f"HostName={host.address.strip('[]')}"]
    variables: dict[str, Any] = {"ansible_ssh_common_args": shlex.join(options)}
    if host.user is not None:
        variables["ansible_user"] = host.user
    if host.port is not None:
        variables["ansible_port"] = host.port
    if host.key is not None:
        variables["ansible_ssh_private_key_file"] = host.key
    if host.python is not None:
        variables["ansible_python_interpreter"] = host.python
    return variables


def _json(value: Any) -> str:
    return json.dumps(value, indent=2) + "\n"
