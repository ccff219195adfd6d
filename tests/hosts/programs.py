"""The Python of a test host: the machine's, one lent to it, an old one, or none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Final

SYSTEM_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
OLDEST: Final = (3, 11)
OLD_SITE: Final = '''\
"""Makes this Python say that it is 3.9."""

import collections
import sys

version = collections.namedtuple("version_info", "major minor micro releaselevel serial")
sys.version_info = version(3, 9, 2, "final", 0)
sys.version = "3.9.2 (default, Feb 28 2021, 17:03:44) \\n[GCC 10.2.1 20210110]"
sys.hexversion = 0x030902F0
'''


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


def feign_old_python(folder: Path) -> None:
    """Makes folder/bin/python3, which works like this machine's but says that it is 3.9."""
    real = python_to_lend()
    assert real is None, "a host with an old Python needs the machine's own python3"
    python = Path("/usr/bin/python3")
    ask = "import json, sys; print(json.dumps(sys.version_info[:2]))"
    major, minor = json.loads(subprocess.run([python, "-c", ask], capture_output=True, check=True).stdout)
    site = folder / "lib" / f"python{major}.{minor}" / "site-packages"
    site.mkdir(parents=True)
    (site / "feigned_version.py").write_text(OLD_SITE)
    (site / "feigned_version.pth").write_text("import feigned_version\n")
    (folder / "bin").mkdir()
    (folder / "bin" / "python").symlink_to(python)
    (folder / "pyvenv.cfg").write_text("home = /usr/bin\ninclude-system-site-packages = false\n")
    wrapper = folder / "bin" / "python3"
    wrapper.write_text(
        '#!/bin/sh\ncase "$1" in -V | --version) echo "Python 3.9.2" && exit ;; esac\n'
        'exec "$(dirname "$0")/python" "$@"\n'
    )
    wrapper.chmod(0o755)
