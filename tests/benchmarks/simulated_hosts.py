"""Many hosts on this machine, as ``ssh`` shows them, each of which takes its time to answer.

What stands on the PATH as ``ssh`` hands its input and output to one process, as which they are all one: that
forks, waits for as long as the host takes, and goes on as the host's program (`deploy.hosts.remote_program`)
in the host's folder. So a host costs this machine next to nothing but that ``ssh``, as it is in the field.

``python -m tests.benchmarks.simulated_hosts FOLDER`` is that process, until its input ends.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from deploy.hosts import remote_program

DOOR: Final = "door"
DELAY: Final = "delay"
"""In a host's folder: how long it takes to answer, s."""
WORDS_BYTES_MAX: Final = 65_536
SSH: Final = f"""#!{sys.executable} -IS
import _socket, os, sys
door = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
door.connect(os.environ["SIMULATED"] + "/{DOOR}")
rights = b"".join(number.to_bytes(4, sys.byteorder) for number in (0, 1, 2))
said = "\\0".join(sys.argv[-2:]).encode()
door.sendmsg([said], [(_socket.SOL_SOCKET, _socket.SCM_RIGHTS, rights)])
for number in (0, 1, 2):
    os.close(number)
os._exit((door.recv(1) or b"\\xff")[0])
"""


def serve(folder: Path) -> None:
    """Is all hosts in `folder`, until standard input ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
        door.bind(str(folder / DOOR))
        door.listen(1024)
        print("ready", flush=True)
        while sys.stdin not in select.select([door, sys.stdin], [], [])[0]:
            client, _ = door.accept()
            if os.fork() == 0:
                door.close()
                _answer(folder, client)
            client.close()


def _answer(folder: Path, client: socket.socket) -> None:
    """Is one host to one ssh; never returns."""
    status = 255
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        said, descriptors, *_ = socket.recv_fds(client, WORDS_BYTES_MAX, 3)
        if not said:
            return  # it was ended before
        for number, descriptor in enumerate(descriptors):
            os.dup2(descriptor, number)
            os.close(descriptor)
        threading.Thread(target=_end_with, args=(client,), daemon=True).start()
        host, remote = said.decode().split("\0")
        os.environ["HOME"] = str(folder / host)
        time.sleep(float((folder / host / DELAY).read_text()))
        status = _run(remote)
    finally:
        with suppress(OSError):  # that ssh was ended
            client.sendall(bytes((status,)))
        os._exit(0)


def _end_with(client: socket.socket) -> None:
    client.recv(1)  # an ssh that is ended ends what it has started
    os._exit(0)


def _run(remote: str) -> int:
    if "host_program" not in remote:
        return os.waitstatus_to_exitcode(os.system(remote))
    program = sys.stdin.buffer
    program.read(int(program.readline()))  # as it is here
    remote_program.main()
    return 0


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
