"""Processes that are forked: real ones, of programs that are a few lines each.

The server is the real one; the program is one of this test.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from handfast.deploy.processes import child, forking
from handfast.deploy.processes.attributes import ROOM, STARTING, YIELDING
from handfast.deploy.processes.child import Child, environment
from handfast.deploy.processes.forking import UNSEEN, ForkedProcess, ForkServer

PATIENCE_S: Final = 30.0
PROGRAM: Final = """
import atexit, json, os, signal, sys, threading, time

def main(argv):
    what, *more = argv
    if what == "exit":
        return int(more[0])
    if what == "raise":
        raise RuntimeError("of the program")
    if what == "leave":
        sys.exit("goes")
    if what == "late":
        atexit.register(lambda: print("at the exit", flush=True))
        threading.Thread(target=lambda: (time.sleep(0.05), print("of a thread", flush=True))).start()
        return 3
    if what == "start":
        from handfast.agent.runtime import preloaded
        own = f"{more[0]}/starting-{os.getpid()}"
        open(own, "w").close()
        for _ in range(20):  # each may cost what a busy machine has to do
            os.sched_yield()
        print(len([name for name in os.listdir(more[0]) if name.startswith("starting")]), flush=True)
        os.unlink(own)
        preloaded.started()
    if what == "tell":
        import numpy, random
        print(json.dumps({
            "argv": sys.argv, "random": random.random(), "numpy": float(numpy.random.rand()),
            "handles": sorted(map(int, os.listdir("/proc/self/fd"))),
            "session": os.getsid(0), "group": os.getpgrp(), "pid": os.getpid(),
            "ids": [os.fstat(number).st_ino for number in (0, 1, 2)], "parent": os.getppid(),
            "threads": len(os.listdir("/proc/self/task")), "wake": signal.set_wakeup_fd(-1),
            "ends": signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL, "gc": __import__("gc").isenabled(),
            "one": os.environ["OMP_NUM_THREADS"],
            "command": open("/proc/self/cmdline").read().rstrip("\\0").split("\\0"),
        }), flush=True)
    print("waits", file=sys.stderr, flush=True)
    while True:
        signal.pause()
"""
"""``python -m trivial WHAT``."""


@pytest.fixture(autouse=True)
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package `trivial`, the only one that can be forked."""
    for name, text in (("trivial/__init__", ""), ("trivial/__main__", PROGRAM)):
        path = tmp_path / "path" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    with open(tmp_path / "path" / "trivial" / "__main__.py", "a") as file:
        file.write('\nif __name__ == "__main__":\n    sys.exit(main(sys.argv[1:]))\n')
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "path"))
    monkeypatch.setattr(forking, "MODULES", {"trivial"})


def preloads(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """Have the server import these lines instead of what it preloads."""
    (folder / "path" / "serves.py").write_text(text)
    monkeypatch.setattr(forking, "PRELOADING", "serves")


@pytest.fixture
def server() -> Iterator[ForkServer]:
    with ForkServer(environment()) as made:
        yield made


def start(server: ForkServer, log: Path, *arguments: str, for_many: bool = False) -> ForkedProcess:
    with open(log, "ab") as output:
        made = server.start("trivial", arguments, output.fileno(), for_many=for_many)
    assert made is not None
    return made


def wait_for(look: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not look():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def waiting(log: Path) -> bool:
    return log.exists() and "waits" in log.read_text()


def state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "X"


def gone(pid: int) -> bool:
    return state(pid) in "ZX"


def test_all_that_is_forked_can_be_told_to_yield(server: ForkServer, tmp_path: Path) -> None:
    def scheduled(pid: int) -> tuple[int, int]:
        return os.sched_getscheduler(pid), os.getpriority(os.PRIO_PROCESS, pid)

    own = os.getpriority(os.PRIO_PROCESS, 0)
    before = start(server, tmp_path / "before", "tell")
    for _ in range(2):
        server.yields(YIELDING)
    after = start(server, tmp_path / "after", "tell")
    assert scheduled(before.pid) == (os.sched_getscheduler(0), own)
    assert scheduled(after.pid) == (os.SCHED_BATCH, max(own, STARTING))
    started = start(server, tmp_path / "started", "start", str(tmp_path))
    more = max(own, STARTING) + YIELDING - STARTING
    wait_for(lambda: scheduled(started.pid) == (os.SCHED_BATCH, min(19, more)))
    many = start(server, tmp_path / "many", "start", str(tmp_path), for_many=True)
    wait_for(lambda: waiting(tmp_path / "many"))
    assert scheduled(many.pid) == (os.SCHED_OTHER, max(own, STARTING)), "robots wait for it"


def test_a_fork_has_nothing_of_the_server(server: ForkServer, tmp_path: Path) -> None:
    logs = [tmp_path / f"{number}.log" for number in range(3)]
    made = []
    for log in logs:
        made.append(start(server, log, "tell", "--exit-with-parent"))
        seen = Path(f"/proc/{made[-1].pid}/cmdline").read_text()
        assert "\0tell\0" in seen, "it is seen as it is at once"
    for log in logs:
        wait_for(lambda log=log: waiting(log))
    told = [json.loads(log.read_text().splitlines()[0]) for log in logs]
    for one, process, log in zip(told, made, logs, strict=True):
        assert one["pid"] == one["group"] == process.pid
        assert one["session"] == os.getsid(0)
        assert one["parent"] == server.pid
        # The last ones are of the pipe from its starter, what tells that it has started, and the list itself.
        assert one["handles"][:3] == [0, 1, 2]
        assert len(one["handles"]) <= 7
        assert one["ids"] == [os.stat(os.devnull).st_ino, log.stat().st_ino, log.stat().st_ino]
        assert one["command"] == [sys.executable, "-P", "-m", "trivial", "tell", "--exit-with-parent"]
        assert one["argv"] == [str(tmp_path / "path/trivial/__main__.py"), "tell", "--exit-with-parent"]
        assert (one["threads"], one["wake"], one["ends"], one["gc"], one["one"]) == (1, -1, True, True, "1")
    for draws in ("random", "numpy"):
        assert len({one[draws] for one in told}) == len(told), f"{draws}: each draws for itself"
    server.close()
    for process in made:
        assert process.wait(PATIENCE_S) == UNSEEN
        assert gone(process.pid)


def test_an_end_is_told_as_it_was(server: ForkServer, tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert start(server, log, "exit", "0").wait(PATIENCE_S) == 0
    assert start(server, log, "exit", "7").wait(PATIENCE_S) == 7
    assert start(server, log, "raise").wait(PATIENCE_S) == 1
    assert "RuntimeError: of the program" in log.read_text()
    assert start(server, log, "leave").wait(PATIENCE_S) == 1
    assert log.read_text().endswith("goes\n")
    assert start(server, log, "late").wait(PATIENCE_S) == 3
    assert log.read_text().endswith("of a thread\nat the exit\n")
    killed = start(server, log, "wait")
    assert killed.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        killed.wait(0.0)
    killed.kill()
    assert killed.wait(PATIENCE_S) == -signal.SIGKILL
    killed.kill()  # whose number may be another's by now
    assert killed.poll() == -signal.SIGKILL


def test_one_starts_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many at a time as there is processor time for; but nobody waits for one that has other reasons."""
    monkeypatch.setattr(forking, "STARTING_MAX", 1)
    for patience_s, program in ((1e6, "start"), (0.0, "wait")):
        monkeypatch.setattr(forking, "START_S", patience_s)
        logs = [tmp_path / f"{program}-{number}.log" for number in range(8)]
        with ForkServer(environment()) as server:
            made = [start(server, log, program, str(tmp_path)) for log in logs]
            for log in logs:
                wait_for(lambda log=log: waiting(log))
            for process in made:
                process.kill()
                process.wait(PATIENCE_S)
    assert [(tmp_path / f"start-{number}.log").read_text() for number in range(8)] == ["1\nwaits\n"] * 8


def test_ends_that_nobody_asks_for_do_not_stand_in_the_way(server: ForkServer, tmp_path: Path) -> None:
    made = [start(server, tmp_path / "log", "exit", str(number)) for number in range(40)]
    assert [process.wait(PATIENCE_S) for process in made[::-1]] == [*range(40)][::-1]


def test_no_handle_is_left(server: ForkServer, tmp_path: Path) -> None:
    def handles() -> tuple[int, int]:
        start(server, tmp_path / "log", "exit", "0").wait(PATIENCE_S)
        return len(os.listdir("/proc/self/fd")), len(os.listdir(f"/proc/{server.pid}/fd"))

    before = handles()
    for _ in range(4):
        handles()
    wait_for(lambda: handles() == before)


def test_whoever_is_left_ends_with_the_server(server: ForkServer, tmp_path: Path) -> None:
    logs = [tmp_path / "1.log", tmp_path / "2.log"]
    made = [Child(number, "agent", "trivial", ["wait"], log, server) for number, log in enumerate(logs)]
    for log in logs:
        wait_for(lambda log=log: waiting(log))
    assert server.pid is not None
    made[0].pause()
    wait_for(lambda: state(made[0].pid) == "T")
    os.kill(server.pid, signal.SIGKILL)
    for each in made:  # one of them is frozen: whose starter is gone is woken by the kernel
        wait_for(each.ended)
        assert each.ended() == "by the end of the fork server"
        each.kill()
    assert all(gone(each.pid) for each in made)


def test_a_server_that_stands_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """How processes end is not known then, but that they do; nothing more can be started by it, nor beside
    it, for it may go on."""
    with ForkServer(environment()) as server, open(tmp_path / "log", "ab") as log:
        made = [start(server, tmp_path / "log", "wait") for _ in range(5)]
        monkeypatch.setattr(forking, "UNTOLD_S", 0.2)
        monkeypatch.setattr(forking, "ANSWER_S", 0.1)
        assert server.pid is not None
        os.kill(server.pid, signal.SIGSTOP)
        assert made[0].poll() is None
        for each in made:
            each.kill()
        assert [each.wait(PATIENCE_S) for each in made] == [UNSEEN] * 5
        with pytest.raises(TimeoutError, match="the process that forks others"):
            server.start("trivial", ["exit", "0"], log.fileno())
        began_s = time.monotonic()
    assert gone(server.pid or 0)
    assert time.monotonic() - began_s < PATIENCE_S, "it is not asked to end"


def test_a_server_that_never_loads_is_done_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forking, "ANSWER_S", 0.1)
    preloads(tmp_path, monkeypatch, "import signal\nwhile True:\n    signal.pause()\n")
    with ForkServer(environment()) as server:
        made = Child(1, "agent", "trivial", ["exit", "4"], tmp_path / "log", server)
        assert made.wait(PATIENCE_S)
        assert made.ended() == "exit status 4"


def test_what_cannot_be_forked_is_started(tmp_path: Path) -> None:
    """A server that is gone, a program that it does not know, a command line that is too long."""
    with ForkServer(environment()) as server, open(tmp_path / "log", "ab") as log:
        assert server.start("json.tool", [], log.fileno()) is None
        assert server.start("trivial", ["x" * ROOM], log.fileno()) is None
        assert server.start("trivial", ["exit", "0"], log.fileno()) is not None
        assert server.pid is not None
        os.kill(server.pid, signal.SIGKILL)
        made = Child(1, "agent", "trivial", ["exit", "4"], tmp_path / "log", server)
        assert made.wait(PATIENCE_S)
        assert made.ended() == "exit status 4"


def test_a_server_that_cannot_serve_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here it has another thread: locks that this one holds would stay locked in a fork."""
    thread = "import threading, time\nthreading.Thread(target=time.sleep, args=(30,), daemon=True).start()\n"
    with monkeypatch.context() as changed:
        preloads(tmp_path, changed, thread + "import handfast.deploy.processes.preloading\n")
        with ForkServer(environment()) as server, open(tmp_path / "log", "ab") as log:
            assert server.start("trivial", ["exit", "0"], log.fileno()) is None
    monkeypatch.delattr(os, "pidfd_open")
    with ForkServer(environment()) as server, open(tmp_path / "log", "ab") as log:
        assert server.pid is None
        assert server.start("trivial", ["exit", "0"], log.fileno()) is None


def test_the_program_that_starts_it_is_not_imported(tmp_path: Path) -> None:
    """A script needs no ``if __name__ == "__main__"``."""
    script = tmp_path / "script.py"
    script.write_text(STARTS.partition("while True")[0] + "print('once', flush=True)\nserver.close()\n")
    told = subprocess.run(
        [sys.executable, str(script), "process", str(tmp_path / "log")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout.count("once") == 1
    assert told.stderr == ""


STARTS: Final = """
import os, signal, sys
from handfast.deploy.processes import forking
from handfast.deploy.processes.child import environment
forking.MODULES = {"trivial"}
server = forking.ForkServer(environment())
server._run()
pids = [server.pid]
if sys.argv[1] == "process":
    made = server.start("trivial", ["wait"], os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT))
    pids.append(made.pid)
if sys.argv[1] == "fork" and os.fork() == 0:
    os.close(1)
    sys.stdin.read()
    os._exit(0)
print(*pids, flush=True)
while True:
    signal.pause()
"""


@pytest.mark.parametrize(("when", "count"), [("at once", 1), ("process", 2), ("fork", 1)])
def test_the_server_ends_with_who_started_it(tmp_path: Path, when: str, count: int) -> None:
    """Killed before the server has loaded everything, when it has processes, and when another process holds
    its end of the socket too."""
    with subprocess.Popen(
        [sys.executable, "-c", STARTS, when, str(tmp_path / "log")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as starter:
        assert starter.stdout is not None
        pids = [*map(int, starter.stdout.readline().split())]
        assert len(pids) == count
        starter.kill()
        starter.wait()
        wait_for(lambda: all(map(gone, pids)))


def test_everything_has_one_thread_for_linear_algebra() -> None:
    assert environment().items() >= child.ONE_THREAD.items()
