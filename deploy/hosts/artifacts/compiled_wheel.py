"""What `make compiled` made, as a wheel for robots' computers that are of this machine's kind.

It holds the compiled modules alone and is installed beside our packages, which are Python: a computer of
another kind gets those, and drives as well.
"""

from __future__ import annotations

import base64
import hashlib
import platform
import sys
import sysconfig
import zipfile
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Final

from handfast.agent.common.compiled import COMPILED
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.console.data_files import ROOT

NAME: Final = "handfast_compiled"
_EPOCH: Final = (2000, 1, 1, 0, 0, 0)


def suffix() -> str:
    """How the name of a compiled module ends that this interpreter loads."""
    return str(sysconfig.get_config_var("EXT_SUFFIX"))


def runs_here(python: tuple[int, int], machine: str, libc: tuple[str, str]) -> bool:
    """Whether a computer runs what was compiled here: of the same processor and Python, and a C library that
    is no older than the one it was linked with."""
    name, version = platform.libc_ver()
    if (python, machine, libc[0]) != (sys.version_info[:2], platform.machine(), name):
        return False
    return not version or _numbers(libc[1]) >= _numbers(version)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


def compiled_modules(packages: tuple[str, ...], root: Path = ROOT) -> dict[str, bytes]:
    """The compiled modules of these packages, by their paths; none where this is the Python form."""
    if not COMPILED:
        return {}
    inside = [path for package in packages for path in sorted((root / package).rglob(f"*{suffix()}"))]
    shared = sorted(root.glob(f"*__mypyc{suffix()}"))  # what all of them load
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in (*shared, *inside)}


def wheel(modules: Mapping[str, bytes]) -> tuple[str, bytes]:
    """File name and content of a wheel of these modules: the same bytes for the same modules."""
    digest = hashlib.sha256()
    for path, data in sorted(modules.items()):
        digest.update(f"{path} {len(data)} ".encode() + data)
    version = f"{handfast_version()}+{digest.hexdigest()[:12]}"
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    tags = f"{tag}-{tag}-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
    info = f"{NAME}-{version}.dist-info"
    files = dict(modules) | {
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {NAME}\nVersion: {version}\n".encode(),
        f"{info}/WHEEL": f"Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: {tags}\n".encode(),
    }
    record = f"{info}/RECORD"
    files[record] = "".join(_recorded(files, record)).encode()
    memory = BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in files.items():
            entry = zipfile.ZipInfo(path, _EPOCH)
            entry.external_attr = 0o755 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data)
    return f"{NAME}-{version}-{tags}.whl", memory.getvalue()


def _recorded(files: Mapping[str, bytes], record: str) -> Iterator[str]:
    for path, data in files.items():
        hashed = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        yield f"{path},sha256={hashed},{len(data)}\n"
    yield f"{record},,\n"
