"""What test hosts and their operator have in common: names, addresses, a login's variables, keys."""

from __future__ import annotations

import os
import pwd
import subprocess
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
ROOT: Final = HERE.parents[1]
SUBNET: Final = "10.213.0"
"""Every set has the same: no two can see each other, nor this machine's networks."""
OPERATOR_ADDRESS: Final = f"{SUBNET}.1"
NOBODYS_ADDRESS: Final = f"{SUBNET}.250"
USER: Final = "rover"
"""The user of a host whose user is not root."""
USER_ID: Final = 2001
TIMEOUT_S: Final = 60.0
Result = subprocess.CompletedProcess[str]


def host_name(number: int) -> str:
    """Of the host of that number, from 1."""
    return f"host{number}"


def host_address(number: int) -> str:
    """Likewise."""
    return f"{SUBNET}.{10 + number}"


def login_variables() -> dict[str, str]:
    """The variables that a login sets."""
    user = pwd.getpwuid(os.geteuid())
    return login_variables_of(user.pw_name, user.pw_dir)


def login_variables_of(name: str, home: str = "") -> dict[str, str]:
    """Likewise, of a user of that name; its home is in /home when left out."""
    return {
        "HOME": home or f"/home/{name}",
        "USER": name,
        "LOGNAME": name,
        "SHELL": "/bin/bash",
        "LANG": "C.UTF-8",
    }


def make_key(path: Path) -> str:
    """Makes a pair of ssh keys; returns the public one, without its comment."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", path], check=True)
    return " ".join(path.with_suffix(".pub").read_text().split()[:2])


def command_line(pid: int) -> str:
    """Of a process; "" when it is gone."""
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return ""
    return line.replace(b"\0", b" ").decode(errors="replace").strip()
