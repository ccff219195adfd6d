"""Who gives orders on this machine, as messages name them."""

from __future__ import annotations

import getpass
import os
import socket

from handfast.agent.messages.types import AUTHOR_MAX


def author() -> str:
    """This process: ``user@host:pid``."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # an id without a name
        user = str(os.getuid())
    text = f"{user}@{socket.gethostname()}"
    pid = f":{os.getpid()}"
    return "".join(c if c.isprintable() else "?" for c in text)[: AUTHOR_MAX - len(pid)] + pid
