"""What is sent to a robot's computer so that nothing has to be fetched there: wheels, our packages, plugins.

The wheels are those that ``robot_requirements.txt`` locks, by version and hash, for the computer's own
processor, C library and Python. They come from where this machine's pip takes packages from, once: a cache
keeps them, so that a fleet can be brought up again in a field. Where this machine's handfast is compiled, one
more wheel holds the compiled modules, for computers that can run them; it is installed beside our packages,
which are Python and run everywhere.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import json
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import threading
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from handfast.agent.common.compiled import COMPILED
from handfast.agent.runtime.version import handfast_version
from handfast.deploy.console.data_files import ROBOT_REQUIREMENTS, ROOT
from handfast.deploy.console.sources import plugin_files
from handfast.deploy.inventory.own_orders import cache_folder

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


PACKAGES: Final = ("handfast/agent", "handfast/plant", "handfast/bridges")
"""What a robot runs; `deploy` is the operator's."""
MODULE: Final = "handfast/__init__.py"
"""What laws and plants of one's own import."""
PLUGINS: Final = "handfast_plugins.txt"
"""Modules of plugins that are sent along, a line each; the installation imports them once."""
DOWNLOAD_TIMEOUT_S: Final = 600.0
GLIBC_OLDEST: Final = 17
_INDEX: Final = "bundle.json"
_locks: dict[Path, threading.Lock] = {}
_failed: dict[Path, str] = {}
"""Why wheels could not be had: not asked for again by this command, host for host."""
_downloads: set[subprocess.Popen[str]] = set()
_guard = threading.Lock()


class BundleError(RuntimeError):
    """Wheels for a computer cannot be had; the text is one clear line."""


@dataclass(frozen=True, slots=True)
class Platform:
    """What wheels have to fit: Python ``(3, 11)``, processor ``aarch64``, C library ``("glibc", "2.36")``."""

    python: tuple[int, int]
    machine: str
    libc: tuple[str, str]

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> Platform:
        """The platform of a computer, from what `deploy.hosts.remote_program.hello` says of it.

        Raises:
            BundleError: it is no Linux.
        """
        if about["system"] != "Linux":
            raise BundleError(f"it runs {about['system']}: robots' computers must run Linux, with systemd")
        major, minor, _ = about["python"]
        name, version = about["libc"]
        return cls((major, minor), about["machine"], (name, version))

    @property
    def tags(self) -> list[str]:
        """Names of platforms whose wheels fit, the best first."""
        if self.libc[0] != "glibc":
            return [f"musllinux_1_{minor}_{self.machine}" for minor in (2, 1)]
        minor = int(self.libc[1].split(".")[1])
        tags = [f"manylinux_2_{k}_{self.machine}" for k in range(minor, GLIBC_OLDEST - 1, -1)]
        return [*tags, f"manylinux2014_{self.machine}"]

    def __str__(self) -> str:
        return f"Python {self.python[0]}.{self.python[1]}, {self.machine}, {' '.join(self.libc) or 'musl'}"


@dataclass(frozen=True)
class Bundle:
    """What one computer needs: wheels by their SHA-256, the file name of pip's among them, and our packages.

    Attributes:
        folder: where the wheels lie on this machine.
        program: our packages, a zip archive.
    """

    folder: Path
    wheels: Mapping[str, str]
    program: bytes

    @property
    def pip(self) -> str:
        return next(name for name in self.wheels if re.match(r"pip-\d", name))

    @cached_property
    def program_name(self) -> str:
        return f"handfast-{hashlib.sha256(self.program).hexdigest()[:16]}.zip"

    @cached_property
    def version(self) -> str:
        """Names what is installed from it: handfast's version, our packages, and last the wheels, which
        differ for computers of different kinds."""
        wheels = json.dumps(sorted(self.wheels.items())).encode()
        digests = (hashlib.sha256(part).hexdigest()[:8] for part in (self.program, wheels))
        return "-".join((handfast_version(), *digests))


def bundle_for(platform: Platform, program: bytes) -> Bundle:
    """The bundle for a computer; fetches the wheels when they are not here yet. Threads may ask at once: one
    fetches, and where it cannot, all others fail with the same reason.

    Raises:
        BundleError: they cannot be had.
    """
    text = ROBOT_REQUIREMENTS.read_text(encoding="utf-8")
    folder = cache_folder("bundles") / hashlib.sha256(f"{text}{platform}".encode()).hexdigest()[:16]
    with _guard:
        lock = _locks.setdefault(folder, threading.Lock())
    with lock:
        if folder in _failed:
            raise BundleError(_failed[folder])
        try:
            wheels = _wheels(folder)
            if wheels is None:
                wheels = _fetch(platform, folder)
        except BundleError as error:
            _failed[folder] = str(error)
            raise
        return Bundle(folder, wheels | _compiled(platform, folder), program)


def _compiled(platform: Platform, folder: Path) -> dict[str, str]:
    """The wheel of what is compiled here, if that is and the computer can run it; by its name, its SHA-256.

    Raises:
        BundleError: it cannot be laid there.
    """
    if not runs_here(platform.python, platform.machine, platform.libc):
        return {}
    modules = compiled_modules(PACKAGES)
    if not modules:
        return {}
    name, data = wheel(modules)
    try:
        if not (folder / name).is_file():
            for old in folder.glob(f"{NAME}-*"):
                old.unlink()
            hidden = folder / f".{name}.new"
            hidden.write_bytes(data)
            hidden.rename(folder / name)
    except OSError as error:
        raise BundleError(f"cannot keep wheels in {folder}: {error.strerror or error}") from None
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest()}


def end_downloads() -> None:
    """Ends downloads that are under way: they fail. May be called from another thread."""
    with _guard:
        for process in _downloads:
            process.kill()


def _wheels(folder: Path) -> dict[str, str] | None:
    """Wheels in a folder of the cache, by name their SHA-256; None where they are not all there."""
    try:
        wheels: dict[str, str] = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return wheels if all((folder / name).is_file() for name in wheels) else None


def _fetch(platform: Platform, folder: Path) -> dict[str, str]:
    """Wheels as `_wheels`. The folder comes to its place whole; another command may have been quicker."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as hidden:
            fetched = Path(hidden) / "bundle"
            fetched.mkdir()
            _download(platform, fetched)
            digests = {
                path.name: hashlib.sha256(path.read_bytes()).hexdigest()
                for path in sorted(fetched.glob("*.whl"))
            }
            (fetched / _INDEX).write_text(json.dumps(digests), encoding="utf-8")
            theirs = _wheels(folder)
            if theirs is None:
                shutil.rmtree(folder, ignore_errors=True)  # left by what was interrupted
                try:
                    fetched.rename(folder)
                except OSError as error:
                    if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                        raise
                theirs = _wheels(folder)
    except OSError as error:
        raise BundleError(f"cannot keep wheels in {folder.parent}: {error.strerror or error}") from None
    if theirs is None:
        raise BundleError(f"cannot keep wheels in {folder}: others remove them")
    return theirs


def _download(platform: Platform, folder: Path) -> None:
    words = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-input"]
    words += ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--dest", str(folder)]
    words += ["--implementation", "cp", "--python-version", f"{platform.python[0]}.{platform.python[1]}"]
    for tag in platform.tags:
        words += ["--platform", tag]
    process = subprocess.Popen(
        [*words, "-r", str(ROBOT_REQUIREMENTS)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    with _guard:
        _downloads.add(process)
    try:
        _, stderr = process.communicate(timeout=DOWNLOAD_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise BundleError(f"wheels for {platform} did not come within {DOWNLOAD_TIMEOUT_S:.0f} s") from None
    finally:
        with _guard:
            _downloads.discard(process)
        process.kill()
        process.communicate()
    if process.returncode < 0:
        raise BundleError(f"no wheels for {platform}: interrupted")
    if process.returncode:
        errors = [line for line in stderr.splitlines() if "ERROR" in line or "No module named" in line]
        said = (errors or stderr.splitlines() or ["pip failed"])[0]
        raise BundleError(f"no wheels for {platform}: {said.removeprefix('ERROR: ')}")


def program_archive(modules: tuple[str, ...] = ()) -> bytes:
    """Our packages as a zip archive; the same bytes for the same files, whichever zlib is here.

    Args:
        modules: of plugins, whose files go with them.

    Raises:
        handfast.deploy.console.sources.PluginFilesError: a plugin cannot be sent.
    """
    memory = BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_STORED) as archive:
        for name, data in _contents(modules):
            entry = zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return memory.getvalue()


def _contents(modules: tuple[str, ...]) -> Iterator[tuple[str, bytes]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.is_file() and path.suffix not in (".pyc", ".so"):  # those are `compiled_wheel`'s
                yield path.relative_to(ROOT).as_posix(), path.read_bytes()
    yield MODULE, (ROOT / MODULE).read_bytes()
    strangers = tuple(name for name in modules if name.partition(".")[0] != "handfast")
    if strangers:
        yield PLUGINS, "\n".join(strangers).encode()
        yield from plugin_files(strangers)
    version = handfast_version()
    metadata = f"Metadata-Version: 2.1\nName: handfast\nVersion: {version}\n"
    yield f"handfast-{version}.dist-info/METADATA", metadata.encode()
