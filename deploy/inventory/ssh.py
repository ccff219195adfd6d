"""The ssh command to a host of a fleet, and what its failures mean.

It is OpenSSH itself, so that its configuration, agents, jump hosts and known hosts hold here as everywhere.
It never asks anything: what would need an answer is a failure that says what to do.
"""

from __future__ import annotations

import re
import resource
import shlex
import subprocess
from pathlib import Path
from typing import Final

from handfast.agent.common.wording import printable
from handfast.agent.fleet.hosts import HostSection

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
    if host.port is not None:
        words += ["-p", str(host.port)]
    if host.key is not None:
        words += ["-i", str(Path(host.key).expanduser())]
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
    if host.port is not None:
        words += ["-p", str(host.port)]
    if host.key is not None:
        words += ["-i", str(Path(host.key).expanduser())]
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
    known_as = (
        changed[1] if changed else f"[{address}]:{host.port}" if host.port not in (None, 22) else address
    )
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
            f"({by_hand(host, 'ssh-copy-id')}), or name another with user and key",
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
