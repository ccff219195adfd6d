"""The hosts of a fleet: where they are, who runs on them, and the ssh command that reaches them.

It is OpenSSH itself, so its configuration, agents, jump hosts and known hosts hold here as everywhere. It
never asks anything: what would need an answer is a failure that says what to do.
"""

from __future__ import annotations

import re
import resource
import shlex
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

from handfast.agent.common.reader import Problem
from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.wording import some

CONNECT_TIMEOUT_S: Final = 6
ALIVE_INTERVAL_S: Final = 3
ALIVE_COUNT: Final = 3
"""A connection over which nothing comes for these together is given up."""
_REASON_MAX: Final = 300


class SshError(RuntimeError):
    """A host cannot be reached, or does not let us in; the text is one clear line."""


def allow_many() -> None:
    """Lets this process have as many files open as its user may: each ssh needs three, and by default no
    process has more than 1024."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def options(host: HostSection, *, accept_new: bool = False) -> list[str]:
    """Options of ssh for a host; what the fleet file leaves out is as ssh's own configuration says.

    Args:
        accept_new: takes the key of a host that was never met before for its own.
    """
    words = [
        *("-T", "-o", "BatchMode=yes"),
        *("-o", f"ConnectTimeout={CONNECT_TIMEOUT_S}"),
        *("-o", f"ServerAliveInterval={ALIVE_INTERVAL_S}", "-o", f"ServerAliveCountMax={ALIVE_COUNT}"),
        *("-o", f"StrictHostKeyChecking={'accept-new' if accept_new else 'yes'}"),
        *("-o", "LogLevel=ERROR"),
    ]
    if host.address is not None:
        words += ["-o", f"HostName={host.address.strip('[]')}"]
    if host.user is not None:
        words += ["-l", host.user]
    return words


def command(host: HostSection, remote: str, *, accept_new: bool = False) -> list[str]:
    """The command that runs `remote` (of a shell) on a host."""
    return ["ssh", *options(host, accept_new=accept_new), "--", host.name, remote]


def address_of(host: HostSection) -> str:
    """Where a host is in the network: as the fleet file says, else as ssh's configuration does.

    Raises:
        SshError: there is no ssh here, or its configuration cannot be read.
    """
    if host.address is not None:
        return host.address
    try:
        done = subprocess.run(
            ["ssh", "-G", *options(host), "--", host.name], capture_output=True, text=True, timeout=10
        )
    except FileNotFoundError:
        raise SshError(NO_SSH) from None
    except subprocess.TimeoutExpired:
        raise SshError("ssh does not say where the host is: give its address in the fleet file") from None
    found = re.search(r"^hostname (\S+)$", done.stdout, re.MULTILINE)
    if done.returncode or found is None:
        raise SshError(f"ssh: {_last(done.stderr) or 'does not say where the host is'}")
    return f"[{found[1]}]" if ":" in found[1] else found[1]


NOT_STARTED: Final = "this computer cannot start ssh"
NO_SSH: Final = "there is no ssh on this machine: install OpenSSH's client"


def by_hand(host: HostSection, program: str = "ssh") -> str:
    """What to type to log in as our commands do; of ``ssh-copy-id`` as well."""
    words = [program]
    if host.address is not None:
        words += ["-o", f"HostName={host.address.strip('[]')}"]
    return shlex.join([*words, f"{host.user}@{host.name}" if host.user is not None else host.name])


def ended(host: HostSection, status: int, said: str) -> str:
    """Why a command on a host ended. A status of 255 is ssh's own, any other that of the program there."""
    if status < 0:
        return LOST
    if status == 255:
        return reason(host, said)
    last = _last(said)
    return f"the program there ended (status {status})" + (f": {last}" if last else "")


LOST: Final = "the connection to it was lost"


def reason(host: HostSection, said: str) -> str:
    """What the errors of ssh mean, and what to do about them."""
    changed = re.search(r"Host key for (\S+) has changed", said)
    address = (host.address or host.name).strip("[]")
    known_as = changed[1] if changed else address
    known: list[tuple[str, str]] = [
        (
            r"REMOTE HOST IDENTIFICATION HAS CHANGED|Host key for .* has changed",
            "its host key is not the one that is known: another computer may pose as it. If you know why "
            f"it has changed, remove the old one ({shlex.join(['ssh-keygen', '-R', printable(known_as)])}), "
            "log in once by hand",
        ),
        (
            r"Host key verification failed|No .* host key is known",
            f"its host key is not known yet: log in once by hand ({by_hand(host)}) and compare it, or give "
            "--accept-new-host-keys, which `up` and `sweep` take",
        ),
        (r"Could not resolve hostname", "nobody knows that name: give its address"),
        (r"Connection refused", "it is there, but no ssh server answers on that port"),
        (r"No route to host|Network is unreachable", "it cannot be reached: there is no way to that address"),
        (r"timed out|Operation timed out|Timeout, server", "it does not answer"),
        # Who has no key is not let in: the key is the reason.
        (r"Identity file .* not accessible|no such identity", "the key file does not exist"),
        (r"Bad owner or permissions|UNPROTECTED PRIVATE KEY", "others may read the key or the configuration"),
        (
            r"Permission denied|Too many authentication failures",
            f"it does not let {host.user or 'you'} in: put your public key there "
            f"({by_hand(host, 'ssh-copy-id')}), or name another user, or another key in ~/.ssh/config",
        ),
        (r"Connection (closed|reset) by|Broken pipe|lost connection", LOST),
    ]
    last = _last(said)
    for pattern, meaning in known:
        if re.search(pattern, said):
            return f"{meaning} (ssh: {last})"
    return f"ssh: {last}" if last else LOST


def _last(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip(" @\r")]
    return printable(lines[-1])[:_REASON_MAX] if lines else ""


ASKED_AT_ONCE: Final = 16


def located(fleet: Fleet) -> Fleet:
    """`fleet` with the address of every host that it uses; what it leaves out ssh's configuration knows.

    Raises:
        InputError: that says nothing, or two of them have one address: two sets of processes would fight
            for its files.
    """
    used = {host.name for host in used_hosts(fleet)}
    unknown = [host for host in fleet.hosts if host.name in used and host.address is None]
    found = _addresses(unknown) if unknown else {}
    hosts = []
    first: dict[str, str] = {}
    for host in fleet.hosts:
        if host.name in found:
            host = replace(host, address=found[host.name])
        if host.name in used and host.address is not None:
            other = first.setdefault(host.address.lower(), host.name)
            if other != host.name:
                raise InputError(
                    f"hosts {other} and {host.name} both have the address {host.address}: robots may share a "
                    "host by its name"
                )
        hosts.append(host)
    return replace(fleet, hosts=tuple(hosts))


def _addresses(hosts: Sequence[HostSection]) -> dict[str, str]:
    """Where hosts are, as ssh's configuration says, by name: asked side by side, for a stop waits for it."""

    def address(host: HostSection) -> str:
        try:
            return address_of(host)
        except SshError as error:
            raise InputError(f"host {host.name}: {error}") from None

    with ThreadPoolExecutor(min(len(hosts), ASKED_AT_ONCE), "address") as pool:
        return dict(zip((host.name for host in hosts), pool.map(address, hosts), strict=True))


def hosts_of(fleet: Fleet, source: str, only: Sequence[str] = ()) -> list[HostSection]:
    """The hosts that the fleet uses, in the file's order; of these, those that are named in `only`.

    Raises:
        InputError: there is none of that name.
        FleetError: the fleet is not for several machines.
    """
    hosts = used_hosts(fleet)
    if not any(robot.host for robot in fleet.robots):
        message = (
            'no robot has a host: write [host.NAME] for each computer and host = "NAME" in each [[robot]], '
            "or drive it on this machine, `handfast run`"
        )
        raise FleetError(source, [Problem("", message)])
    strangers = sorted(set(only) - {host.name for host in hosts})
    if strangers:
        what = "robots or a router" if any(router.host for router in fleet.routers) else "robots"
        raise InputError(
            f"there is no host {some(strangers)} with {what} in {fleet.fleet.name}; there are: "
            f"{some(host.name for host in hosts)}"
        )
    return [host for host in hosts if not only or host.name in only]


def used_hosts(fleet: Fleet) -> list[HostSection]:
    """The hosts on which robots or routers run, in the file's order."""
    used = {robot.host for robot in fleet.robots} | {router.host for router in fleet.routers}
    return [host for host in fleet.hosts if host.name in used]


def robots_on(fleet: Fleet, host: HostSection) -> tuple[int, ...]:
    """Ids of the robots whose processes run on a host, in the file's order."""
    return tuple(robot.id for robot in fleet.robots if robot.host == host.name)


def refuse_simulated(fleet: Fleet, source: str) -> None:
    """A simulated rover is started by `run` only. `FleetError` where a fleet for hosts has one."""
    problems = [
        Problem(
            f"robot[{number}].mavlink.connection",
            '"simulator" is for `run` and `preflight` on one machine: start `handfast rover-simulator` on '
            "the host and give its port, such as udpin:127.0.0.1:14550",
        )
        for number, robot in enumerate(fleet.robots, 1)
        if robot.is_simulated
    ]
    if problems:
        raise FleetError(source, problems)


def robots_text(fleet: Fleet) -> str:
    """The fleet file that robots read: resolved and located, without how the operator logs in."""
    import tomli_w  # here: only this needs it

    hosts = tuple(HostSection(host.name, host.address, host.listen) for host in fleet.hosts)
    return tomli_w.dumps(to_dict(replace(fleet, hosts=hosts)))
