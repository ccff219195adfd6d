"""The Python of a test host: the machine's, one lent to it, or none."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Final

SYSTEM_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
OLDEST: Final = (3, 11)


@cache
def python_to_lend() -> Path | None:
    """The installation whose bin/python3 a host must be lent; None when it finds a good one by itself."""
    for folder in SYSTEM_PATH.split(os.pathsep):
        python = Path(folder, "python3")
        if python.exists():
            ask = f"import ensurepip, sys, venv; sys.exit(sys.version_info < {OLDEST})"
            good = subprocess.run([python, "-I", "-c", ask], capture_output=True).returncode == 0
            return None if good else Path(sys.base_prefix)
    return Path(sys.base_prefix)


def hide_python(folder: Path) -> None:
    """Makes folder/bin: all programs of SYSTEM_PATH but Python."""
    target = folder / "bin"
    target.mkdir()
    for source in SYSTEM_PATH.split(os.pathsep):
        for program in Path(source).iterdir() if Path(source).is_dir() else ():
            link = target / program.name
            if not program.name.startswith(("python", "pip")) and not link.is_symlink():
                link.symlink_to(program)
