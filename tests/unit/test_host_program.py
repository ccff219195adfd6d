"""The program on a host, with a systemctl that only notes what it was told."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.host_sections import HostSection
from deploy.host_connection import HostConnection

FAKE_SSH = '#!/bin/sh\nfor last; do :; done\nexec /bin/sh -c "$last"\n'
FAKE_SYSTEMCTL = """#!/bin/sh
echo "$@" >> "$HOME/told"
case "$*" in
  *is-system-running*) echo running ;;
  *list-units*) cat "$HOME/loaded" 2>/dev/null ;;
  *show*) cat "$HOME/shown" 2>/dev/null ;;
esac
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    home.mkdir()
    for name, text in (("ssh", FAKE_SSH), ("systemctl", FAKE_SYSTEMCTL)):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    (tools / "python3").symlink_to(sys.executable)
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    monkeypatch.setenv("HOME", str(home))
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    return home


@pytest.fixture
def host(home: Path) -> Iterator[HostConnection]:
    with HostConnection(HostSection("rover1", "10.0.0.1")) as connection:
        yield connection


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    """A process that runs as a unit's would.

    It says when it runs: between ``exec`` and the first instruction its command line may read as empty.
    """
    words = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        yield child
        child.send_signal(signal.SIGKILL)


def told(home: Path) -> list[str]:
    file = home / "told"
    lines = file.read_text().splitlines() if file.exists() else []
    file.unlink(missing_ok=True)
    return [line.removeprefix("--user --no-pager ") for line in lines]


AGENT = "handfast-two-robot-1-agent.service"
OTHER = "handfast-two-robot-2-agent.service"
STRANGER = "handfast-two-robotics-robot-1-agent.service"


def units(home: Path) -> Path:
    return home / ".config/systemd/user"


def test_units_are_written_once_and_those_not_wanted_go(home: Path, host: HostConnection) -> None:
    told(home)
    assert host.ask("units", fleet="two", wanted={AGENT: "a", OTHER: "b"}) == [AGENT, OTHER]
    assert "daemon-reload" in told(home)
    assert (units(home) / AGENT).read_text() == "a"
    host.ask("units", fleet="two", wanted={AGENT: "a", OTHER: "b"})
    assert "daemon-reload" not in told(home), "nothing has changed"
    (units(home) / STRANGER).write_text("of another fleet")
    host.ask("units", fleet="two", wanted={AGENT: "a"})
    orders = told(home)
    assert f"stop {OTHER}" in orders
    assert sorted(path.name for path in units(home).iterdir()) == [AGENT, STRANGER]


def test_a_unit_runs_as_wanted_when_its_process_is_what_its_file_says(
    home: Path, host: HostConnection, sleeper: subprocess.Popen[bytes]
) -> None:
    words = Path(f"/proc/{sleeper.pid}/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    right = f"# runs: {json.dumps([word.decode() for word in words])}\n"
    shown = f"ActiveState=active\nMainPID={sleeper.pid}\n"
    (home / "shown").write_text(shown)
    assert host.ask("units", fleet="two", wanted={AGENT: right}) == []
    other = right.replace("60", "61")
    assert host.ask("units", fleet="two", wanted={AGENT: other}) == [AGENT], "it runs something else"
    (home / "shown").write_text(shown.replace("=active", "=activating"))
    assert host.ask("units", fleet="two", wanted={AGENT: right}) == [AGENT]
    (home / "shown").write_text("ActiveState=active\nMainPID=0\n")
    assert host.ask("units", fleet="two", wanted={AGENT: right}) == [AGENT]


def test_down_stops_and_removes_all_and_says_what_is_left(home: Path, host: HostConnection) -> None:
    host.ask("units", fleet="two", wanted={AGENT: "a"})
    state = home / ".local/share/handfast/fleets/two/state"
    state.mkdir(parents=True)
    (home / "loaded").write_text(f"{OTHER} loaded failed failed x\n")
    told(home)
    answer = host.ask("down", fleet="two")
    assert answer["stopped"] == [AGENT, OTHER]
    assert answer["left"] == [OTHER], "systemd still knows of it"
    assert f"stop {AGENT} {OTHER}" in told(home)
    assert not list(units(home).iterdir())
    assert not state.exists()


def test_a_process_that_outlived_its_unit_is_found(home: Path, host: HostConnection) -> None:
    folder = home / ".local/share/handfast/fleets/two"
    folder.mkdir(parents=True)
    words = [sys.executable, "-m", "timeit", "-n", "1", "import time; time.sleep(60)", str(folder / "x")]
    child = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        left = host.ask("down", fleet="two")["left"]
        assert left == [f"process {child.pid}"]
    finally:
        child.kill()
        child.wait()


def test_old_versions_go_but_those_in_use(home: Path, host: HostConnection) -> None:
    versions = home / ".local/share/handfast/versions"
    for name in ("1-aa", "1-bb", "1-cc"):
        (versions / name).mkdir(parents=True)
    host.ask("units", fleet="two", wanted={AGENT: "ExecStart=/h/versions/1-bb/bin/python"})
    assert host.ask("tidy", keep=["1-cc"]) == ["1-aa"]
    assert sorted(path.name for path in versions.iterdir()) == ["1-bb", "1-cc"]


def test_an_installation_that_was_interrupted_does_not_count(home: Path, host: HostConnection) -> None:
    folder = home / ".local/share/handfast/versions/1-aa"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin/python").write_text("")
    assert host.ask("installed", version="1-aa") is False
    (folder / ".complete").touch()
    assert host.ask("installed", version="1-aa") is True
