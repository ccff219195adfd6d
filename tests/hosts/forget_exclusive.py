"""Lets a pseudo terminal forget with its last user that it was his alone, as a serial port does by itself.

python forget_exclusive.py LINK      # to the terminal; as root, for whom no terminal is another's alone
"""

import fcntl
import os
import sys
import termios
import time
from contextlib import suppress
from pathlib import Path

LOOK_S = 0.1


def in_use(device: str) -> bool:
    """Whether any process has it open."""
    for folder in Path("/proc").glob("[0-9]*/fd"):
        with suppress(OSError):
            for handle in folder.iterdir():
                with suppress(OSError):
                    if os.readlink(handle) == device:
                        return True
    return False


while True:
    time.sleep(LOOK_S)
    with suppress(OSError):
        device = os.path.realpath(sys.argv[1])
        if not in_use(device):
            terminal = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            fcntl.ioctl(terminal, termios.TIOCNXCL)
            os.close(terminal)
