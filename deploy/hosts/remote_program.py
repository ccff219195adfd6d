"""What runs on a robot's computer while an operator's command talks to it over ssh.

It is sent along each time and imports nothing but the standard library, so nothing has to be installed there
before, and both ends are always of one version. It reads requests on stdin, answers on stdout, and ends when
its input does; what outlives it are files and systemd user units.

A request is a line of JSON, ``{"do": name, ...arguments, "blob": n}``, and n bytes. The answer is one as
well: ``{"ok": result, "blob": n}`` and n bytes, or ``{"error": text}``.
"""

from __future__ import annotations

import fcntl
import grp
import hashlib
import json
import os
import platform
import pwd
import re
import select
import shutil
import signal
import stat
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

GREETING: Final = b"handfast host program 1\n"
SYSTEMCTL_TIMEOUT_S: Final = 30.0
INSTALL_TIMEOUT_S: Final = 300.0
LOOK_S: Final = 0.5
"""How often an installation looks whether anybody still waits for it."""
RESERVE_BYTES: Final = 50_000_000
"""No file is put when less than this would be left of the disk."""
STOP_FILE: Final = "stop.json"
"""As robots look for it (`agent.runtime.order_store`)."""
ORDERS_BYTES_MAX: Final = 1_000_000
STOPS_SHOWN: Final = 2
STOP_TEXT_MAX: Final = 8_000
CERTIFICATE_BYTES_MAX: Final = 16_384
COMPLETE: Final = ".complete"
PLUGINS: Final = "handfast_plugins.txt"
LOCK: Final = ".lock"
LINGER: Final = Path("/var/lib/systemd/linger")
TRIED: Final = re.compile(r"^# sandbox: tried [^\n]*\n.*?^# sandbox: until here$", re.MULTILINE | re.DOTALL)
"""Settings of a unit that need not work here (`deploy.hosts.systemd_units`)."""
WRITES: Final = re.compile(r"^ReadWritePaths=.*\n", re.MULTILINE)
"""The one of them that is each unit's own: its folders need not be there, so it cannot fail."""
LEFT_OUT: Final = "# sandbox: left out, as users' units can have no namespaces on this computer"
TRIAL: Final = (
    "import os, socket, sys; sys.exit('not closed') if os.access(os.path.expanduser('~'), os.W_OK) else "
    "socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b'READY=1', os.environ['NOTIFY_SOCKET'])"
)
"""Neither quotation marks nor signs that systemd would expand."""

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
        "machine": platform.machine(),
        "system": platform.system(),
        "libc": list(platform.libc_ver()),
        "user": user,
        "root": str(root()),
        "free_bytes": shutil.disk_usage(folder).free,
        "writable": os.access(folder, os.W_OK),
        "systemd": user_manager(),
        "lingers": (LINGER / user).exists(),
        "journal": reads_journal(),
    }


@request
def clock() -> int:
    """Wall clock, ns: how far it is off shows from how long the question took."""
    return time.time_ns()


def environment() -> dict[str, str]:
    """The environment of commands to the user's systemd: not every login over ssh says where it is."""
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
    words: list[str], timeout_s: float, *, check: bool = True, text: str = "", waited_for: bool = False
) -> subprocess.CompletedProcess[str]:
    """Runs a program; `HostError` with the end of what it said when it cannot be or, to `check`, fails.

    Args:
        waited_for: it and its children are also ended when nobody waits for the answer any more.
    """
    name = Path(words[0]).name
    pipe = subprocess.PIPE
    try:
        child = subprocess.Popen(
            words,
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            text=True,
            errors="replace",
            env=environment(),
            start_new_session=True,
        )
    except FileNotFoundError:
        raise HostError(f"there is no {words[0]}") from None
    deadline = time.monotonic() + timeout_s
    pending: str | None = text
    while True:
        left_s = deadline - time.monotonic()
        try:
            out, said = child.communicate(pending, timeout=max(0.0, min(left_s, LOOK_S)))
            break
        except subprocess.TimeoutExpired:
            pending = None  # it was passed on
            if left_s > 0 and not (waited_for and nobody_waits()):
                continue
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        raise HostError(f"{name} did not end within {timeout_s:.0f} s" if left_s <= 0 else GONE)
    if check and child.returncode:
        lines = (said.strip() or out.strip() or f"exit status {child.returncode}").splitlines()
        raise HostError(f"{name}: {lines[-1][:300]}")
    return subprocess.CompletedProcess(words, child.returncode, out, said)


GONE: Final = "nobody waits for the answer any more"


def nobody_waits() -> bool:
    """Whether nobody reads our answers any more. Our input tells nothing: all of it may have come at once."""
    poll = select.poll()
    poll.register(1, 0)
    return bool(poll.poll(0))


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
    """SHA-256 of a file, hexadecimal; "" where it cannot be read."""
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""


@request
def put(path: str, blob: bytes) -> None:
    """Writes a file whole or not at all."""
    target = inside(path)
    target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    free = shutil.disk_usage(target.parent).free
    if free < len(blob) + RESERVE_BYTES:
        raise HostError(
            f"the disk is full: {free / 1e6:.0f} MB are free in {target.parent}, "
            f"{(len(blob) + RESERVE_BYTES) / 1e6:.0f} MB are needed"
        )
    write(target, blob)


def write(target: Path, data: bytes) -> None:
    """Writes a file whole or not at all: under a hidden name first, then renamed."""
    hidden = target.with_name(f".{target.name}.new")
    with suppress(FileNotFoundError):
        hidden.unlink()
    handle = os.open(hidden, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
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
    """Whether an installation of that version was finished here and has not been removed since."""
    folder = inside(f"versions/{version}")
    return (folder / COMPLETE).exists() and (folder / "bin" / "python").exists()


@request
def install(version: str, wheels: list[str], pip: str, program: str) -> None:
    """Makes that version from wheels and our own packages, all of which were put here before."""
    with alone(INSTALL_TIMEOUT_S):
        if not installed(version):  # another operator may just have done it
            make_version(inside(f"versions/{version}"), wheels, pip, program)


@contextmanager
def alone(timeout_s: float) -> Iterator[None]:
    """Within it no other operator's program installs or removes versions here; waits so long for that."""
    root().mkdir(mode=0o700, parents=True, exist_ok=True)
    with open(root() / LOCK, "wb") as lock:
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise HostError("another installation is under way there: try again later") from None
            if nobody_waits():
                raise HostError(GONE)
            time.sleep(LOOK_S)
        yield


def make_version(folder: Path, wheels: list[str], pip: str, program: str) -> None:
    """Installs into a folder."""
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted installation left
    words = [sys.executable, "-P", "-m", "venv", "--without-pip", str(folder)]
    command(words, 60.0, waited_for=True)
    python = str(folder / "bin" / "python")
    files = [str(inside(wheel)) for wheel in wheels]
    quiet = ["--quiet", "--disable-pip-version-check", "--no-cache-dir"]
    offline = ["--isolated", "--no-index", "--no-deps", "--no-compile"]
    command(
        [sys.executable, "-P", f"{inside(pip)}/pip", "--python", python, "install", *quiet, *offline, *files],
        INSTALL_TIMEOUT_S,
        waited_for=True,
    )
    found = command([python, "-P", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], 30.0)
    modules = ["handfast.agent.__main__", "handfast.plant.__main__", "handfast.bridges.mavlink.__main__"]
    with zipfile.ZipFile(inside(program)) as archive:
        archive.extractall(found.stdout.strip())
        if PLUGINS in archive.namelist():
            modules += archive.read(PLUGINS).decode().split()
    # What agents and plants load is compiled here and now, and shown to load.
    command([python, "-P", "-c", f"import {', '.join(modules)}"], 120.0, waited_for=True)
    os.sync()  # a power loss must not leave the mark without what it stands for
    (folder / COMPLETE).touch()


@request
def tidy(keep: list[str]) -> list[str]:
    """Removes versions that no unit of this user's mentions, but for those named; returns what went."""
    gone = []
    with alone(0.0):
        files = units_folder().glob("handfast-*.service")
        used = "\n".join(path.read_text(errors="replace") for path in files)
        for folder in sorted(root().glob("versions/*")):
            if folder.name not in keep and f"/versions/{folder.name}/" not in used:
                shutil.rmtree(folder, ignore_errors=True)
                gone.append(folder.name)
    return gone


# ---------------------------------------------------------------------- units


PROPERTIES: Final = (
    "Id",
    "ActiveState",
    "Result",
    "MainPID",
    "NRestarts",
    "StatusText",
    "NeedDaemonReload",
)


def shown(patterns: Collection[str]) -> dict[str, dict[str, str]]:
    """What systemd says of units, by name: of those that are named, and of those it knows that match."""
    done = systemctl("show", "--all", f"--property={','.join(PROPERTIES)}", "--", *patterns, check=False)
    found = {}
    for block in done.stdout.split("\n\n"):
        about = dict(line.split("=", 1) for line in block.splitlines() if "=" in line)
        if name := about.pop("Id", ""):
            found[name] = about
    return found


def units_of(fleet: str) -> dict[str, dict[str, str]]:
    """What systemd says of the units of a fleet that have a file here or are loaded still, by name."""
    masks = [f"handfast-{fleet}-{whose}*.service" for whose in ("robot-", "router")]
    files = [path.name for mask in masks for path in units_folder().glob(mask)]
    known = shown([*masks, *files])
    pattern = re.compile(rf"handfast-{re.escape(fleet)}-(robot-\d+-[a-z]+|router)\.service")
    return {name: known.get(name, {}) for name in sorted({*files, *known}) if pattern.fullmatch(name)}


@request
def compare(fleet: str, wanted: dict[str, str]) -> dict[str, list[str]]:
    """How the fleet's units differ from those that are wanted (name -> text); changes nothing.

    Returns names: `stale`, which do not run, or run something else than they should; `unwritten`, whose
    files are not as they should be; `unwanted`, which should not be here; `open`, of which settings are left
    out that this computer does not have.
    """
    there, asked, wanted = units_of(fleet), wanted, fitted(wanted)
    # Robots whose folder for orders was removed keep none until they start again: they no longer see it.
    forgetful = not inside(f"fleets/{fleet}/orders").is_dir()
    return {
        "stale": [
            name
            for name, text in wanted.items()
            if (forgetful and "--orders" in text) or not runs_as_wanted(text, there.get(name, {}))
        ],
        "unwritten": [
            name
            for name, text in wanted.items()
            if file_text(name) != text or there.get(name, {}).get("NeedDaemonReload") == "yes"
        ],
        "unwanted": [name for name in there if name not in wanted],
        "open": [name for name, text in wanted.items() if text != asked[name]],
    }


def fitted(wanted: dict[str, str]) -> dict[str, str]:
    """Units' texts (name -> text) without the settings that do not work on this computer."""
    found = {}
    for name, text in wanted.items():
        tried = TRIED.search(text)
        works = tried is None or sandbox_works(WRITES.sub("", tried[0]))
        found[name] = text if works else TRIED.sub(LEFT_OUT, text)
    return found


@cache
def sandbox_works(settings: str) -> bool:
    """Whether a unit with these settings starts here, speaks to systemd, and is kept from writing.

    Where a kernel or distribution gives users no namespaces, systemd fails to start some units, and leaves
    out in others, without a word, what it was asked for.
    """
    name = f"handfast-trial-{os.getpid()}.service"
    folder = Path(environment()["XDG_RUNTIME_DIR"]) / "systemd" / "user"
    python = sys.executable.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    text = ["[Service]", "Type=notify", "TimeoutStartSec=10", "LimitCORE=0"]
    text += [f'ExecStart="{python}" -I -c "{TRIAL}"', settings]
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    write(folder / name, "\n".join(text).encode())
    try:
        systemctl("daemon-reload")
        return systemctl("start", name, check=False).returncode == 0
    finally:
        systemctl("stop", name, check=False)
        systemctl("reset-failed", name, check=False)
        (folder / name).unlink()
        systemctl("daemon-reload", check=False)


def file_text(name: str) -> str | None:
    """What a unit's file says, None where there is none."""
    try:
        return (units_folder() / name).read_text(errors="replace")
    except FileNotFoundError:
        return None


def runs_as_wanted(text: str, about: dict[str, str]) -> bool:
    """Whether a unit is active, its process is what `text` says, and has read what `text` says it reads."""
    pid = about.get("MainPID", "0")
    if about.get("ActiveState") != "active" or listed("runs", text) != command_line(pid):
        return False
    age_s = used(pid).get("age_s")
    if age_s is None:
        return False
    # Hosts whose clock is off are refused before anything is written: wall times of now and of files can
    # be compared, whatever the clock was when the process started. A file of the future tells nothing.
    now_s = time.time()
    return not any(now_s - age_s < modified_s(path) <= now_s for path in listed("reads", text))


def listed(what: str, text: str) -> list[str]:
    """The words of a unit file's line ``# WHAT: [...]``."""
    found = re.search(rf"^# {what}: (\[.*\])$", text, re.MULTILINE)
    return list(json.loads(found[1])) if found else []


def command_line(pid: str) -> list[str]:
    """Words of a process's command line; none when it is gone."""
    try:
        data = Path(f"/proc/{int(pid)}/cmdline").read_bytes()
    except (OSError, ValueError):
        return []
    return os.fsdecode(data).rstrip("\0").split("\0")


def modified_s(path: str) -> float:
    """When a file was written to last, wall time; 0 when it is not there."""
    try:
        return os.stat(path).st_mtime
    except OSError:
        return 0.0


@request
def units(wanted: dict[str, str]) -> None:
    """Writes unit files (name -> text); what runs goes on as it is."""
    folder = units_folder()
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    for name, text in fitted(wanted).items():
        for path in listed("writes", text):  # the process itself may write nowhere else
            Path(path).expanduser().mkdir(mode=0o700, parents=True, exist_ok=True)
        if file_text(name) != text:
            write(folder / name, text.encode())
    systemctl("daemon-reload")


@request
def restart(names: list[str]) -> None:
    """Has units start, or start again; does not wait for that."""
    if names:
        systemctl("reset-failed", *names, check=False)
        systemctl("restart", "--no-block", *names)


@request
def states(names: list[str]) -> dict[str, str]:
    """Units' states in a word or two."""
    known = shown(names)
    found = {}
    for name in names:
        about = known.get(name, {})
        active, result = about.get("ActiveState", "unknown"), about.get("Result", "success")
        found[name] = active if result == "success" else f"{active} ({result})"
    return found


@request
def last_lines(name: str, count: int) -> list[str]:
    """The last lines that a unit's process said."""
    words = ["journalctl", "-q", "-t", name.removesuffix(".service"), "-o", "cat", "--no-pager"]
    done = command([*words, "-n", str(count)], 10.0, check=False)
    return [line[:300] for line in done.stdout.splitlines() if line.strip()]


@request
def remove(names: list[str]) -> None:
    """Stops units, waits for that, and removes them and their files."""
    if not names:  # systemctl would take that for all units
        return
    systemctl("stop", *names, check=False)
    for name in names:
        with suppress(FileNotFoundError):
            (units_folder() / name).unlink()
    systemctl("reset-failed", *names, check=False)
    systemctl("daemon-reload", check=False)


@request
def down(fleet: str) -> dict[str, Any]:
    """Stops and removes a fleet's units; says which there were and what is left in spite of it."""
    names = list(units_of(fleet))
    remove(names)
    shutil.rmtree(inside(f"fleets/{fleet}/state"), ignore_errors=True)
    return {"stopped": names, "left": [*units_of(fleet), *processes(fleet)]}


def processes(fleet: str) -> list[str]:
    """Processes of a fleet of this user's, as far as they can be seen: ``process PID``."""
    needle = f"{root()}/fleets/{fleet}/"
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        words = command_line(folder.name)
        if "-m" in words and any(needle in word for word in words):
            found.append(f"process {folder.name}")
    return found


@request
def status(fleet: str) -> dict[str, Any]:
    """What the fleet's units here do: by name, what systemd says, CPU time and memory of its process."""
    units = {}
    for name, about in units_of(fleet).items():
        pid = about.get("MainPID", "0")
        found = re.search(r"/versions/([^/]+)/bin/python ", " ".join(command_line(pid)))
        units[name] = {**about, **used(pid), "version": found[1] if found else ""}
    return {
        "units": units,
        "load": os.getloadavg()[0],
        "cores": os.cpu_count() or 1,
        "certificates": certificates(fleet),
    }


def certificates(fleet: str) -> dict[str, str]:
    """The certificates (PEM) of a fleet's robots and router here, by file; they are public."""
    found, folder = {}, inside(f"fleets/{fleet}/keys")
    for path in sorted([*folder.glob("*.robot.*.crt"), *folder.glob("*.router.*.crt")]):
        with suppress(OSError):
            if not path.name.endswith(".next.crt") and path.stat().st_size <= CERTIFICATE_BYTES_MAX:
                found[path.name] = path.read_text(errors="replace")
    return found


@request
def order(fleet: str, blob: bytes) -> list[str]:
    """Lays an operator's stop where the fleet's robots here look for one; the stop that lay there before."""
    folder = inside(f"fleets/{fleet}/orders")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    before = first_orders(folder / STOP_FILE)
    write(folder / STOP_FILE, blob)
    return before


@request
def kept(fleet: str, processes: list[str]) -> dict[str, Any]:
    """What processes of the fleet say of themselves, None for those that are no unit here, and the first of
    the orders that they have kept, which are stops and resumes: no mission, which may be large; and the wall
    clock, ns."""
    folder, units = inside(f"fleets/{fleet}/orders"), units_of(fleet)
    found = {}
    for process in processes:
        about = units.get(f"handfast-{fleet}-{process}.service")
        says = None if about is None else about.get("StatusText", "")[:STOP_TEXT_MAX]
        found[process] = {"says": says, "orders": first_orders(folder / f"{process}.json")}
    return {"processes": found, "time_ns": time.time_ns()}


def first_orders(path: Path) -> list[str]:
    """The first orders in a file of kept ones; none where it is none."""
    with suppress(OSError, ValueError, TypeError, KeyError):
        with open(path, encoding="ascii") as stream:
            texts = json.loads(stream.read(ORDERS_BYTES_MAX))["orders"]
        return [text for text in texts[:STOPS_SHOWN] if len(text) <= STOP_TEXT_MAX]
    return []


@request
def orders(fleet: str, most: int) -> list[str]:
    """The stops and resumes that robots of the fleet have kept here, `most` of them, whether the robots are
    up or not; the stop that was laid there first."""
    folder = inside(f"fleets/{fleet}/orders")
    paths = [folder / STOP_FILE, *sorted(folder.glob("robot-*.json"))]
    return list(dict.fromkeys(text for path in paths for text in first_orders(path)))[:most]


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


# ---------------------------------------------------------------------- what was installed, and what it left


@request
def run(module: str, arguments: list[str], version: str, text: str = "") -> str:
    """Runs one of our own modules with an installed version; returns what it prints."""
    python = inside(f"versions/{version}") / "bin" / "python"
    return command([str(python), "-P", "-m", module, *arguments], 60.0, text=text).stdout


@request
def listing(folder: str, pattern: str, most: int) -> dict[str, tuple[int, float]]:
    """Files in a folder of ours, the `most` last by name: their sizes, when they were written to last (s)."""
    found = {}
    for path in sorted(inside(folder).glob(pattern))[-most:]:
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


# ---------------------------------------------------------------------- serial ports of vehicles


PORTS: Final = ("serial/by-id/*", "serial[0-9]*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyTHS*")
"""What there may be a vehicle at, below /dev."""
PORTS_MAX: Final = 8


@request
def ports(paths: list[str]) -> dict[str, dict[str, Any]]:
    """What can be told of serial ports by looking, without opening one, by path: see `port`."""
    return {path: port(path) for path in paths}


def port(path: str, dev: str = "/dev", proc: str = "/proc") -> dict[str, Any]:
    """What can be told of one port.

    Returns `there`: the ports that are there instead, where it is not; `kind`: what it is, where it is no
    port; `denied`: the group that may use it, and this user may not ("" none may); `late`: that group, where
    the user's systemd began before the user was in it; `console`: the console or login that is on it;
    `modem`: whether ModemManager runs, which asks USB ports whether they are modems. What is well is left
    out.
    """
    try:
        about = os.stat(path)
    except OSError:
        return {"there": others(dev)}
    if not stat.S_ISCHR(about.st_mode):
        return {"kind": "a folder" if stat.S_ISDIR(about.st_mode) else "a file"}
    found: dict[str, Any] = {}
    if not os.access(path, os.R_OK | os.W_OK):
        shared = about.st_mode & 0o060 == 0o060
        found["denied"] = group_name(about.st_gid) if shared else ""
    elif os.getuid() not in (0, about.st_uid) and about.st_mode & 0o006 != 0o006:
        began = manager_groups(proc)
        if began is not None and about.st_gid not in began:
            found["late"] = group_name(about.st_gid)
    name = os.path.basename(os.path.realpath(path))
    if taken := console(name, path, proc):
        found["console"] = taken
    if name.startswith(("ttyACM", "ttyUSB")) and any(running("ModemManager", proc)):
        found["modem"] = True
    return found


def others(dev: str) -> list[str]:
    """Ports that are there; one with several names by the first of them, which stays with it."""
    first: dict[str, str] = {}
    for pattern in PORTS:
        for found in sorted(Path(dev).glob(pattern)):
            first.setdefault(os.path.realpath(found), str(found))
    return list(first.values())[:PORTS_MAX]


def group_name(number: int) -> str:
    """Name of a group, or its number."""
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def manager_groups(proc: str) -> set[int] | None:
    """Groups that this user's systemd has, and so its units; None where it is not found."""
    for folder in running("systemd", proc):
        with suppress(OSError, ValueError):
            if folder.stat().st_uid != os.getuid() or b"--user" not in (folder / "cmdline").read_bytes():
                continue
            told = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
            return {int(number) for name in ("Groups", "Gid") for number in told[name].split()}
    return None


def running(name: str, proc: str) -> Iterator[Path]:
    """The processes of that name."""
    for folder in Path(proc).glob("[0-9]*"):
        with suppress(OSError):
            if (folder / "comm").read_text().strip() == name:
                yield folder


def console(name: str, path: str, proc: str) -> str:
    """What of the system speaks on a port, by its name below /dev; "" nothing."""
    with suppress(OSError):
        if any(line.split()[:1] == [name] for line in Path(proc, "consoles").read_text().splitlines()):
            return "the kernel's console"
    for getty in (*running("agetty", proc), *running("getty", proc)):
        with suppress(OSError):
            words = os.fsdecode((getty / "cmdline").read_bytes()).split("\0")
            if {name, path, os.path.basename(path), f"/dev/{name}"} & set(words):
                return "a login"
    return ""


# ---------------------------------------------------------------------- the loop


def answer(line: bytes, blob: bytes) -> Answer:
    """The answer to one request: a line of JSON, and its data."""
    asked = json.loads(line)
    name = asked.pop("do")
    if asked.pop("blob", None) is not None:
        asked["blob"] = blob
    result = REQUESTS[name](**asked)
    return result if isinstance(result, tuple) else (result, b"")


def main() -> None:
    """Answers the requests on standard input, one after the other, until it ends."""
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
            # A mistake of ours: reported in one line there, with its place.
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
