"""What a process may do where it runs: prints it as JSON, each try with "" or why it was refused, and tells
systemd that it is ready. Run in the place of a robot's process by its unit.

python sandbox_probe.py FOLDER...        # those that it shall be able to write to
"""

import ctypes
import json
import mmap
import os
import pathlib
import socket
import sys
import threading
from collections.abc import Callable
from functools import partial

HOME = pathlib.Path.home()
RUNTIME = pathlib.Path(os.environ["XDG_RUNTIME_DIR"])
KEYS = ".local/share/handfast/fleets/pair/keys"
NEW_USER, SIZE_OF_LOG = 0x10000000, 10
libc = ctypes.CDLL(None, use_errno=True)


def write_in(folder: pathlib.Path) -> None:
    place = folder / f"probe-{os.getpid()}"
    place.touch()
    place.unlink()


def call(name: str, *arguments: int | None) -> None:
    if getattr(libc, name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def connect(path: pathlib.Path) -> None:
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(str(path))


def set_user_bit() -> None:
    place = pathlib.Path(sys.argv[1]) / f"probe-{os.getpid()}"
    place.touch()
    try:
        place.chmod(0o4700)
    finally:
        place.unlink()


def thread() -> None:
    started = threading.Thread(target=int)
    started.start()
    started.join()


TRIES: dict[str, Callable[[], object]] = {
    "write home": lambda: write_in(HOME),
    "write a unit": lambda: write_in(HOME / ".config/systemd/user"),
    "write the program": lambda: write_in(HOME / ".local/share/handfast/versions"),
    "write keys": lambda: write_in(HOME / KEYS),
    "read keys": lambda: os.listdir(HOME / KEYS),
    "read ssh": lambda: os.listdir(HOME / ".ssh"),
    "write others' tmp": lambda: pathlib.Path("/tmp/others").write_text("x"),
    "write tmp": lambda: write_in(pathlib.Path("/tmp")),
    "write shared memory": lambda: write_in(pathlib.Path("/dev/shm")),
    "systemd": lambda: connect(RUNTIME / "systemd/private"),
    "bus": lambda: connect(RUNTIME / "bus"),
    "write a control group": lambda: os.close(os.open("/sys/fs/cgroup/cgroup.procs", os.O_WRONLY)),
    "look into others": lambda: pathlib.Path(f"/proc/{os.getppid()}/environ").read_bytes(),
    "packets": lambda: socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM),
    "kernel's log": lambda: call("klogctl", SIZE_OF_LOG, None, 0),
    "executable memory": lambda: mmap.mmap(-1, 4096, prot=7),
    "set-user-ID": set_user_bit,
    "realtime": lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1)),
    "devices": lambda: os.stat("/dev/tty0"),
    "thread": thread,
    "name": lambda: socket.getaddrinfo("host1", 7600),
    "tcp": lambda: socket.create_server(("0.0.0.0", 0)).close(),
    **{f"write {folder}": partial(write_in, pathlib.Path(folder)) for folder in sys.argv[1:]},
    "namespace": lambda: call("unshare", NEW_USER),  # the last one, as nothing is this user's in it
}
found = {}
for name, attempt in TRIES.items():
    try:
        attempt()
        found[name] = ""
    except OSError as error:
        found[name] = error.strerror or str(error)
print(json.dumps(found), flush=True)
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
    notify.sendto(b"READY=1", os.environ["NOTIFY_SOCKET"])
