"""What runs on a robot's computer while an operator's command talks to it over ssh.

It is sent along each time and imports nothing but the standard library, so nothing has to be installed there
before, and both ends are always of one version. It reads requests on stdin, answers on stdout, and ends when
its input does; what outlives it are files and systemd user units.

A request is a line of JSON, ``{"do": name, ...arguments, "blob": n}``, and n bytes. The answer is one as
well: ``{"ok": result, "blob": n}`` and n bytes, or ``{"error": text}``.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import pwd
import re
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

GREETING: Final = b"handfast host program 1\n"
SYSTEMCTL_TIMEOUT_S: Final = 30.0
INSTALL_TIMEOUT_S: Final = 300.0
RESERVE_BYTES: Final = 50_000_000
"""No file is put when less than this would be left of the disk."""
COMPLETE: Final = ".complete"
LINGER: Final = Path("/var/lib/systemd/linger")
BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
CGROUPS: Final = Path("/sys/fs/cgroup")

Answer = tuple[Any, bytes]


class HostError(Exception):
    """What a request cannot do; the text is one clear line."""


REQUESTS: Final[dict[str, Callable[..., Any]]] = {}


def request(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a function one that the other end can ask for, by its name."""
    REQUESTS[function.__name__] = function
    return function


# ---------------------------------------------------------------------- places


def root() -> Path:
    """The folder of all that is handfast's on this computer."""
    data = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(data) / "handfast"


def units_folder() -> Path:
    """Where this user's units lie."""
    config = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(config) / "systemd" / "user"


def inside(path: str) -> Path:
    """The file of that name in our folder; refuses one that would lie elsewhere."""
    found = (root() / path).absolute()
    if ".." in Path(path).parts or not found.is_relative_to(root().absolute()):
        raise HostError(f"{path} is not within {root()}")
    return found


# ---------------------------------------------------------------------- what there is


@request
def hello() -> dict[str, Any]:
    """What this computer is and has."""
    folder = root()
    while not folder.exists():
        folder = folder.parent
    user = pwd.getpwuid(os.getuid()).pw_name
    return {
        "python": list(sys.version_info[:3]),
        "executable": sys.executable,
        "machine": platform.machine(),
        "system": platform.system(),
        "libc": list(platform.libc_ver()),
        "host": platform.node(),
        "user": user,
        "root": str(root()),
        "free_bytes": shutil.disk_usage(folder).free,
        "writable": os.access(folder, os.W_OK),
        "boot": BOOT_ID.read_text().strip() if BOOT_ID.exists() else "",
        "systemd": user_manager(),
        "lingers": (LINGER / user).exists(),
        "journal": reads_journal(),
    }


@request
def clock() -> int:
    """Wall clock, ns: how far it is off shows from how long the question took."""
    return time.time_ns()


def environment() -> dict[str, str]:
    """That of commands to the user's systemd: not every login over ssh says where it is."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
    return os.environ | {
        "XDG_RUNTIME_DIR": runtime,
        "LC_ALL": "C",
        "SYSTEMD_COLORS": "0",
        "SYSTEMD_PAGER": "",
    }


def user_manager() -> str:
    """State of this user's systemd, "" when there is none."""
    try:
        done = systemctl("is-system-running", check=False)
    except HostError:
        return ""
    state = done.stdout.strip()
    return state if state in ("running", "degraded", "starting", "initializing", "maintenance") else ""


def systemctl(*arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Runs ``systemctl --user``; raises as `command`."""
    return command(["systemctl", "--user", "--no-pager", *arguments], SYSTEMCTL_TIMEOUT_S, check=check)


def command(
    words: list[str], timeout_s: float, *, check: bool = True, text: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a program; `HostError` with the end of what it said when it cannot be or, to `check`, fails."""
    try:
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            env=environment(),
            timeout=timeout_s,
            input="" if text is None else text,
        )
    except FileNotFoundError:
        raise HostError(f"there is no {words[0]}") from None
    except subprocess.TimeoutExpired:
        raise HostError(f"{Path(words[0]).name} did not end within {timeout_s:.0f} s") from None
    if check and done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}").splitlines()
        raise HostError(f"{Path(words[0]).name}: {said[-1][:300]}")
    return done


def reads_journal() -> bool:
    """Whether this user may read what its units say."""
    try:
        done = command(["journalctl", "-q", "-n", "1", "--no-pager"], 10.0, check=False)
    except HostError:
        return False
    return done.returncode == 0


# ---------------------------------------------------------------------- files


@request
def missing(paths: dict[str, str]) -> list[str]:
    """Which of these files (path -> SHA-256) are not here as they should be."""
    return [path for path, digest in paths.items() if sha256(inside(path)) != digest]


def sha256(path: Path) -> str:
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""


@request
def put(path: str, blob: bytes, mode: int = 0o644) -> None:
    """Writes a file whole or not at all."""
    target = inside(path)
    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    free = shutil.disk_usage(target.parent).free
    if free < len(blob) + RESERVE_BYTES:
        raise HostError(
            f"the disk is full: {free / 1e6:.0f} MB are free in {target.parent}, "
            f"{(len(blob) + RESERVE_BYTES) / 1e6:.0f} MB are needed"
        )
    write(target, blob, mode)


def write(target: Path, data: bytes, mode: int) -> None:
    hidden = target.with_name(f".{target.name}.new")
    with suppress(FileNotFoundError):
        hidden.unlink()
    handle = os.open(hidden, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with open(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        hidden.rename(target)
    except BaseException:
        with suppress(FileNotFoundError):
            hidden.unlink()
        raise


# ---------------------------------------------------------------------- installation


@request
def installed(version: str) -> bool:
    """Whether that version is here, whole, with a Python that works."""
    folder = inside(f"versions/{version}")
    return (folder / COMPLETE).exists() and (folder / "bin" / "python").exists()


@request
def install(version: str, wheels: list[str], pip: str, program: str) -> None:
    """Makes that version from wheels and our own packages, all of which were put here before."""
    folder = inside(f"versions/{version}")
    needed, free = 400_000_000, shutil.disk_usage(root()).free
    if free < needed:
        raise HostError(
            f"the disk is full: {free / 1e6:.0f} MB are free in {root()}, {needed / 1e6:.0f} MB are needed"
        )
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted installation left
    command([sys.executable, "-m", "venv", "--without-pip", str(folder)], 60.0)
    python = str(folder / "bin" / "python")
    files = [str(inside(wheel)) for wheel in wheels]
    quiet = ["--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    offline = ["--isolated", "--no-index", "--no-deps", "--no-compile"]
    command(
        [sys.executable, f"{inside(pip)}/pip", "--python", python, "install", *quiet, *offline, *files],
        INSTALL_TIMEOUT_S,
    )
    found = command([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], 30.0)
    with zipfile.ZipFile(inside(program)) as archive:
        archive.extractall(found.stdout.strip())
    # What agents and plants load is compiled here and now, and shown to load.
    command([python, "-P", "-c", "import agent.__main__, plant.__main__, bridges.mavlink.__main__"], 120.0)
    (folder / COMPLETE).touch()


@request
def tidy(keep: list[str]) -> list[str]:
    """Removes versions that no unit of this user's mentions, but for those named; returns what went."""
    used = "\n".join(path.read_text(errors="replace") for path in units_folder().glob("handfast-*.service"))
    gone = []
    for folder in sorted(root().glob("versions/*")):
        if folder.name not in keep and f"/versions/{folder.name}/" not in used:
            shutil.rmtree(folder, ignore_errors=True)
            gone.append(folder.name)
    return gone


# ---------------------------------------------------------------------- units


def unit_names(fleet: str) -> list[str]:
    """Units of a fleet that have a file here or are loaded still."""
    files = [path.name for path in units_folder().glob(f"handfast-{fleet}-robot-*.service")]
    listed = systemctl(
        "list-units", "--all", "--plain", "--no-legend", f"handfast-{fleet}-robot-*.service", check=False
    )
    loaded = [line.split()[0] for line in listed.stdout.splitlines() if line.split()]
    pattern = re.compile(rf"handfast-{re.escape(fleet)}-robot-\d+-[a-z]+\.service")
    return sorted({name for name in (*files, *loaded) if pattern.fullmatch(name)})


@request
def units(fleet: str, wanted: dict[str, str]) -> list[str]:
    """Makes the fleet's unit files those that are wanted (name -> text), ends what is not wanted any more.

    Returns the wanted ones that do not run, or run something else than their file says.
    """
    folder = units_folder()
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    remove_units([name for name in unit_names(fleet) if name not in wanted])
    changed = False
    for name, text in wanted.items():
        path = folder / name
        if not path.exists() or path.read_text() != text:
            write(path, text.encode(), 0o644)
            changed = True
    if changed:
        systemctl("daemon-reload")
    return [name for name in wanted if not runs_as_wanted(name)]


def runs_as_wanted(name: str) -> bool:
    """Whether a unit is active, and its process is what its file says."""
    about = shown(name)
    if about.get("ActiveState") != "active":
        return False
    try:
        running = Path(f"/proc/{about['MainPID']}/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    except (OSError, KeyError):
        return False
    text = (units_folder() / name).read_text()
    words = re.search(r"^# runs: (\[.*\])$", text, re.MULTILINE)
    return words is not None and [word.encode() for word in json.loads(words[1])] == running


PROPERTIES: Final = ("ActiveState", "Result", "MainPID", "NRestarts", "StatusText")


def shown(name: str) -> dict[str, str]:
    """What systemd says of a unit."""
    done = systemctl("show", name, f"--property={','.join(PROPERTIES)}", check=False)
    return dict(line.split("=", 1) for line in done.stdout.splitlines() if "=" in line)


@request
def restart(names: list[str]) -> None:
    """Has units start, or start again; does not wait for that."""
    if names:
        systemctl("reset-failed", *names, check=False)
        systemctl("restart", "--no-block", *names)


@request
def state(name: str) -> str:
    """A unit's state in a word or two."""
    about = shown(name)
    active, result = about.get("ActiveState", "unknown"), about.get("Result", "success")
    return active if result == "success" else f"{active} ({result})"


@request
def last_lines(name: str, count: int) -> list[str]:
    """The last lines that a unit's process said."""
    words = ["journalctl", "-q", "-t", name.removesuffix(".service"), "-o", "cat", "--no-pager"]
    done = command([*words, "-n", str(count)], 10.0, check=False)
    return [line[:300] for line in done.stdout.splitlines() if line.strip()]


def remove_units(names: list[str]) -> None:
    """Stops units, waits for that, and removes them and their files."""
    if not names:
        return
    systemctl("stop", *names, check=False)
    for name in names:
        systemctl("disable", name, check=False)
        with suppress(FileNotFoundError):
            (units_folder() / name).unlink()
    systemctl("reset-failed", *names, check=False)
    systemctl("daemon-reload", check=False)


@request
def down(fleet: str) -> dict[str, Any]:
    """Stops and removes a fleet's units; says which there were and what is left in spite of it."""
    names = unit_names(fleet)
    remove_units(names)
    shutil.rmtree(inside(f"fleets/{fleet}/state"), ignore_errors=True)
    return {"stopped": names, "left": [*unit_names(fleet), *processes(fleet)]}


def processes(fleet: str) -> list[str]:
    """Processes of a fleet on this computer that this user may see: ``process PID (what)``."""
    needle = f"/fleets/{fleet}/".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if any(needle in word for word in words) and b"-m" in words:
                found.append(f"process {folder.name}")
    return found


@request
def status(fleet: str) -> dict[str, Any]:
    """What the fleet's units here do: by name, what systemd says, CPU time and memory of its process."""
    told = {}
    for name in unit_names(fleet):
        about: dict[str, Any] = dict(shown(name))
        about.update(used(about.get("MainPID", "0")))
        text = ""
        with suppress(OSError):
            text = (units_folder() / name).read_text()
        found = re.search(r"/versions/([^/]+)/", text)
        about["version"] = found[1] if found else ""
        told[name] = about
    return {"units": told, "load": os.getloadavg()[0], "cores": os.cpu_count() or 1}


def used(pid: str) -> dict[str, float]:
    """CPU time (s), age (s) and resident memory (bytes) of a process; nothing where there is none."""
    try:
        fields = Path(f"/proc/{int(pid)}/stat").read_text().rpartition(")")[2].split()
        pages = int(Path(f"/proc/{int(pid)}/statm").read_text().split()[1])
        up_s = float(Path("/proc/uptime").read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return {}
    tick = os.sysconf("SC_CLK_TCK")
    return {
        "cpu_s": (int(fields[11]) + int(fields[12])) / tick,
        "age_s": max(0.0, up_s - int(fields[19]) / tick),
        "memory_bytes": float(pages * os.sysconf("SC_PAGE_SIZE")),
    }


# ---------------------------------------------------------------------- the loop


@request
def run(module: str, arguments: list[str], version: str, text: str = "") -> str:
    """Runs one of our own modules with an installed version; returns what it prints."""
    python = inside(f"versions/{version}") / "bin" / "python"
    return command([str(python), "-P", "-m", module, *arguments], 60.0, text=text).stdout


@request
def listing(folder: str, pattern: str) -> dict[str, tuple[int, float]]:
    """Files in a folder of ours, by name: their sizes, and when they were written to last (s)."""
    found = {}
    for path in sorted(inside(folder).glob(pattern)):
        with suppress(OSError):
            if path.is_file():
                about = path.stat()
                found[path.name] = about.st_size, about.st_mtime
    return found


@request
def get(path: str, offset: int = 0, most: int = 1 << 20) -> Answer:
    """A part of a file of ours."""
    with open(inside(path), "rb") as stream:
        stream.seek(offset)
        return None, stream.read(most)


def answer(line: bytes, blob: bytes) -> Answer:
    asked = json.loads(line)
    name = asked.pop("do")
    if asked.pop("blob", None) is not None:
        asked["blob"] = blob
    result = REQUESTS[name](**asked)
    return result if isinstance(result, tuple) else (result, b"")


def main() -> None:
    source, sink = sys.stdin.buffer, sys.stdout.buffer
    os.umask(0o077)
    sink.write(b"\n" + GREETING)
    sink.flush()
    while line := source.readline():
        size = json.loads(line).get("blob") or 0
        blob = source.read(size)
        if len(blob) < size:
            return
        try:
            result, data = answer(line, blob)
            head: dict[str, Any] = {"ok": result, "blob": len(data)}
        except HostError as error:
            head, data = {"error": str(error)}, b""
        except OSError as error:
            where = f" {error.filename}" if error.filename else ""
            head, data = {"error": f"{(error.strerror or str(error)).lower()}{where}"}, b""
        except Exception as error:
            # A mistake of ours: told in one line there, with its place.
            trace = error.__traceback__
            while trace is not None and trace.tb_next is not None:
                trace = trace.tb_next
            place = f" (line {trace.tb_lineno})" if trace is not None else ""
            head, data = {"error": f"{type(error).__name__}: {error}{place}"}, b""
        sink.write(json.dumps(head).encode() + b"\n" + data)
        sink.flush()


if __name__ == "__main__":
    with suppress(BrokenPipeError, KeyboardInterrupt):
        main()
