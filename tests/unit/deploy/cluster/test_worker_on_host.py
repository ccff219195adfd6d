"""What starts and ends a worker on a host, with a program that stands for the worker's Python."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from handfast.deploy.cluster import worker_on_host
from handfast.deploy.cluster.worker_on_host import Started
from handfast.deploy.hosts.remote_program import HostError
from tests.process.harness import environment, running, wait_for


def program(folder: Path, text: str) -> Path:
    """An executable that runs some Python, whatever its arguments."""
    path = folder / "python"
    path.write_text(f"#!{sys.executable}\n{text}\n")
    path.chmod(0o755)
    return path


def test_it_is_told_its_settings_and_ends_with_all_that_it_started(tmp_path: Path) -> None:
    started = Started(
        program(
            tmp_path,
            "import pathlib, subprocess, sys\n"
            "line = sys.stdin.readline()\n"
            "child = subprocess.Popen(['sleep', '1000'])\n"
            "pathlib.Path('pid.new').write_text(str(child.pid))\n"
            "pathlib.Path('told').write_text(line)\n"
            "pathlib.Path('pid.new').rename('pid')\n"
            "child.wait()",
        ),
        {"name": "host1"},
    )
    pid = started.folder / "pid"
    try:
        wait_for(pid.exists, "its child", 30.0)
        child = int(pid.read_text())
        assert json.loads((started.folder / "told").read_text()) == {
            "name": "host1",
            "folder": str(started.folder),
        }
        assert started.ended() == ""
    finally:
        started.end()
    wait_for(lambda: not running(child), "the end of its child", 30.0)
    assert not started.folder.exists()


def test_how_it_ended_is_said_with_its_last_line(tmp_path: Path) -> None:
    started = Started(
        program(tmp_path, "import sys; print('first'); sys.exit('no way to the scheduler')"), {}
    )
    wait_for(started.ended, "its end", 30.0)
    assert started.ended() == "its worker ended (status 1): no way to the scheduler"
    started.end()


def test_without_ssh_nobody_says_where_the_scheduler_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(os.environ, "SSH_CONNECTION", raising=False)
    with pytest.raises(HostError, match="SSH_CONNECTION"):
        worker_on_host.start_worker("1", 8786, {})


ORPHAN = """
import json, pathlib, sys
from handfast.deploy.cluster import worker_on_host
worker_on_host.UNASKED_S = 0.3
worker_on_host.inside = lambda _: pathlib.Path(sys.argv[1])
worker_on_host.start_worker("1", 8786, {})
print(worker_on_host._started[-1].folder, flush=True)
for _ in sys.stdin:
    print(worker_on_host.worker_ended(), flush=True)
"""


def test_it_ends_after_its_worker_where_nobody_asks_any_more(tmp_path: Path) -> None:
    """Its connection may have been cut: then it reads from it for ever."""
    (tmp_path / "bin").mkdir()
    program(tmp_path / "bin", "import sys; sys.exit('the scheduler is gone')")
    command = [sys.executable, "-c", ORPHAN, str(tmp_path)]
    surroundings = environment() | {"SSH_CONNECTION": "127.0.0.1 50000 127.0.0.1 22"}
    with subprocess.Popen(
        command, env=surroundings, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        folder = Path(child.stdout.readline().strip())
        said = ""
        until_s = time.monotonic() + 1.0
        while time.monotonic() < until_s or not said:  # for longer than it is left alone
            print(file=child.stdin, flush=True)
            said = child.stdout.readline().strip()
        assert said == "its worker ended (status 1): the scheduler is gone"
        assert folder.exists()
        assert child.wait(30.0) == 1, "its standard input is open still"
    assert not folder.exists()
