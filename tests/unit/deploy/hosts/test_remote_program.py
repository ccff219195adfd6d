"""The program on a host, with a systemctl that only notes what it was told."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.hosts import remote_program, systemd_units
from handfast.deploy.hosts.connection import HostConnection
from tests.process.harness import wait_for

FAKE_SSH = '#!/bin/sh\nfor last; do :; done\nexec /bin/sh -c "$last"\n'
FAKE_SYSTEMCTL = """#!/bin/sh
echo "$@" >> "$HOME/told"
case "$*" in
  *is-system-running*) echo running ;;
  *show*) cat "$HOME/shown" 2>/dev/null ;;
  *" start handfast-trial-"*)
    cat "$XDG_RUNTIME_DIR"/systemd/user/handfast-trial-*.service >>"$HOME/tried"
    test ! -e "$HOME/refuses"
    ;;
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
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
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


def compared(host: HostConnection, **wanted: str) -> dict[str, list[str]]:
    """How the units of robots 1 and 2 differ from these, by the first word of what differs."""
    names = {"agent": AGENT, "other": OTHER}
    found = host.ask("compare", fleet="two", wanted={names[key]: text for key, text in wanted.items()})
    return {what: differ for what, differ in found.items() if differ}


def show(home: Path, pid: int, state: str = "active", unit: str = AGENT, **more: str) -> None:
    """Has systemctl show a unit, beside one that somebody else has."""
    lines = [f"Id={STRANGER}", "ActiveState=active", ""]
    lines += [f"Id={unit}", f"MainPID={pid}", f"ActiveState={state}", *(f"{k}={v}" for k, v in more.items())]
    (home / "shown").write_text("\n".join(lines) + "\n")


def runs(child: subprocess.Popen[bytes], reads: Sequence[Path] = ()) -> str:
    """Text of a unit whose process that is."""
    words = Path(f"/proc/{child.pid}/cmdline").read_text().rstrip("\0").split("\0")
    return f"# runs: {json.dumps(words)}\n# reads: {json.dumps(list(map(str, reads)))}\n"


def test_units_are_compared_and_nothing_is_written(home: Path, host: HostConnection) -> None:
    assert compared(host, agent="a") == {"stale": [AGENT], "unwritten": [AGENT]}
    assert not units(home).exists()
    host.ask("units", wanted={AGENT: "a", OTHER: "b"})
    assert "daemon-reload" in told(home)
    assert (units(home) / AGENT).read_text() == "a"
    (units(home) / STRANGER).write_text("of another fleet")
    assert compared(host, agent="a") == {"stale": [AGENT], "unwanted": [OTHER]}
    assert told(home) == [
        f"show --all --property=Id,ActiveState,Result,MainPID,NRestarts,StatusText,NeedDaemonReload -- "
        f"handfast-two-robot-*.service handfast-two-router*.service "
        f"{' '.join(path.name for path in units(home).glob('*-two-robot-*'))}"
    ], "systemd is asked once"
    host.ask("remove", names=[OTHER])
    assert f"stop {OTHER}" in told(home)
    assert sorted(path.name for path in units(home).iterdir()) == [AGENT, STRANGER]


def test_a_router_is_a_unit_of_the_fleet(home: Path, host: HostConnection) -> None:
    names = ["handfast-two-router.service"]
    others = ["handfast-two-router-robot-1-agent.service", "handfast-two-router-router.service"]
    host.ask("units", wanted=dict.fromkeys([*names, *others], "a"))
    assert compared(host, agent="a")["unwanted"] == names, "not those of a fleet named two-router"
    show(home, 0, NeedDaemonReload="no")
    assert sorted(host.ask("down", fleet="two")["stopped"])[-1:] == names
    assert sorted(path.name for path in units(home).iterdir()) == others


CLOSED = f"a\n{systemd_units.TRIED}\nPrivateUsers=yes\nReadWritePaths=-/%d\n{systemd_units.UNTIL}\nb"


def test_settings_that_do_not_work_here_are_tried_and_left_out(home: Path, tmp_path: Path) -> None:
    for refuses in (False, True):
        (home / "refuses").touch() if refuses else None
        with HostConnection(HostSection("rover1", "10.0.0.1")) as host:
            wanted = {AGENT: CLOSED % 1, OTHER: CLOSED % 2}
            assert host.ask("compare", fleet="two", wanted=wanted)["open"] == [AGENT, OTHER][: 2 * refuses]
            host.ask("units", wanted=wanted)
            assert host.ask("compare", fleet="two", wanted=wanted)["unwritten"] == []
        left = f"a\n{remote_program.LEFT_OUT}\nb"
        assert (units(home) / AGENT).read_text() == (left if refuses else CLOSED % 1)
        trial = (home / "tried").read_text()
        assert trial.count("[Service]") == trial.count("\nPrivateUsers=yes\n") == 1, "once in a connection"
        assert "ReadWritePaths" not in trial
        (home / "tried").unlink()
        assert not list((tmp_path / "runtime/systemd/user").iterdir()), "nothing of it stays"


def test_a_unit_runs_as_wanted_when_its_process_is_what_is_wanted(
    home: Path, host: HostConnection, sleeper: subprocess.Popen[bytes]
) -> None:
    right = runs(sleeper)
    show(home, sleeper.pid)
    host.ask("units", wanted={AGENT: "a"})
    assert compared(host, agent=right) == {"unwritten": [AGENT]}, "what its file says does not count"
    assert "stale" in compared(host, agent=right.replace("60", "61")), "it runs something else"
    show(home, sleeper.pid, "activating")
    assert "stale" in compared(host, agent=right)
    show(home, 0)
    assert "stale" in compared(host, agent=right)
    show(home, sleeper.pid, unit=OTHER)
    assert compared(host, agent=right, other=right)["stale"] == [AGENT], "each is what is said of it"


def test_robots_whose_folder_for_orders_was_removed_start_again(
    home: Path, host: HostConnection, sleeper: subprocess.Popen[bytes]
) -> None:
    unit = runs(sleeper)
    keeps = f"{unit}# --orders\n"
    show(home, sleeper.pid)
    assert "stale" not in compared(host, agent=unit)
    assert compared(host, agent=keeps)["stale"] == [AGENT]
    host.exchange("order", b"{}", fleet="two")
    assert "stale" not in compared(host, agent=keeps)


def test_a_unit_whose_certificate_was_renewed_since_it_started_does_not_run_as_wanted(
    home: Path, host: HostConnection, sleeper: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    certificate = tmp_path / "robot.crt"
    show(home, sleeper.pid)
    started = time.time() - host.ask("status", fleet="two")["units"][AGENT]["age_s"]
    for modified, stale in ((started - 5.0, False), (time.time(), True), (time.time() + 3600.0, False)):
        certificate.touch()
        os.utime(certificate, (modified, modified))
        assert ("stale" in compared(host, agent=runs(sleeper, [certificate]))) is stale
    certificate.unlink()
    assert "stale" not in compared(host, agent=runs(sleeper, [certificate])), "the process will say so"


def test_a_version_is_that_of_the_process_not_of_the_file(home: Path, host: HostConnection) -> None:
    python = home / "versions/1-bb/bin/python"
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    words = [str(python), "-c", "import time; print(flush=True); time.sleep(60)"]
    host.ask("units", wanted={AGENT: "ExecStart=/h/versions/1-cc/bin/python"})
    with subprocess.Popen(words, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        show(home, child.pid)
        assert host.ask("status", fleet="two")["units"][AGENT]["version"] == "1-bb"
        child.kill()
    show(home, 0, "inactive")
    assert host.ask("status", fleet="two")["units"][AGENT]["version"] == ""


def test_certificates_are_told_and_no_keys(home: Path, host: HostConnection) -> None:
    keys = remote_program.inside("fleets/delta/keys")
    keys.mkdir(parents=True)
    for name in ("delta.robot.1.crt", "delta.robot.1.key", "delta.robot.1.next.crt", "ca.crt"):
        (keys / name).write_text(name)
    (keys / "delta.robot.2.crt").write_text("x" * (remote_program.CERTIFICATE_BYTES_MAX + 1))
    assert host.ask("status", fleet="delta")["certificates"] == {"delta.robot.1.crt": "delta.robot.1.crt"}
    assert host.ask("status", fleet="none")["certificates"] == {}


def test_down_stops_and_removes_all_and_says_what_is_left(home: Path, host: HostConnection) -> None:
    host.ask("units", wanted={AGENT: "a"})
    state = home / ".local/share/handfast/fleets/two/state"
    state.mkdir(parents=True)
    show(home, 0, "failed", OTHER)
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
    words = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)", "-m"]
    child, others = (
        subprocess.Popen([*words, path], stdout=subprocess.PIPE)
        for path in (str(folder / "x"), "/home/other/.local/share/handfast/fleets/two/x")
    )
    for each in (child, others):
        assert each.stdout is not None
        with each.stdout:
            each.stdout.readline()  # it runs: see `sleeper`
    try:
        left = host.ask("down", fleet="two")["left"]
        assert left == [f"process {child.pid}"]
    finally:
        for each in (child, others):
            each.kill()
            each.wait()


def test_old_versions_go_but_those_in_use(home: Path, host: HostConnection) -> None:
    versions = home / ".local/share/handfast/versions"
    for name in ("1-aa", "1-bb", "1-cc"):
        (versions / name).mkdir(parents=True)
    host.ask("units", wanted={AGENT: "ExecStart=/h/versions/1-bb/bin/python"})
    assert host.ask("tidy", keep=["1-cc"]) == ["1-aa"]
    assert sorted(path.name for path in versions.iterdir()) == ["1-bb", "1-cc"]


def test_an_installation_that_was_interrupted_does_not_count(home: Path, host: HostConnection) -> None:
    folder = home / ".local/share/handfast/versions/1-aa"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin/python").write_text("")
    assert host.ask("installed", version="1-aa") is False
    (folder / ".complete").touch()
    assert host.ask("installed", version="1-aa") is True


FAKE_PYTHON = """#!/bin/sh
# What an installation runs: `venv` makes another one of these, and pip, whose own child it waits for.
CHILD='echo $$ >> "$HOME/pips"; sleep 60; true'
case "$*" in
  *venv*) for last; do :; done; mkdir -p "$last/bin"; cp "$0" "$last/bin/python" ;;
  *sysconfig*) echo "$HOME" ;;
  *pip*) echo "$$" >> "$HOME/pips"; [ ! -e "$HOME/slow" ] || sh -c "$CHILD" ;;
esac
"""


@pytest.fixture
def installs(home: Path, tmp_path: Path) -> list[str]:
    """Words of a Python on the host for which `install` is quick, or with a file `slow` at home lasts."""
    fake = tmp_path / "fake"
    fake.write_text(FAKE_PYTHON)
    fake.chmod(0o755)
    root = home / ".local/share/handfast"
    (root / "wheels").mkdir(parents=True)
    with zipfile.ZipFile(root / "wheels/program.zip", "w"):
        pass
    source = Path(remote_program.__file__).read_text().replace("sys.executable", repr(str(fake)))
    asked = {
        "do": "install",
        "version": "1-aa",
        "wheels": [],
        "pip": "pip.whl",
        "program": "wheels/program.zip",
    }
    (tmp_path / "program.py").write_text(source)
    (tmp_path / "asked").write_text(json.dumps(asked) + "\n")
    return [sys.executable, str(tmp_path / "program.py")]


def install(words: Sequence[str]) -> subprocess.Popen[bytes]:
    """Asks for an installation, as its only request: no input is left."""
    with open(Path(words[-1]).parent / "asked", "rb") as asked:
        return subprocess.Popen(words, stdin=asked, stdout=subprocess.PIPE)


def answered(child: subprocess.Popen[bytes]) -> dict[str, object]:
    out, _ = child.communicate(timeout=30.0)
    found: dict[str, object] = json.loads(out.splitlines()[-1])
    return found


def pips(home: Path, count: int) -> list[int]:
    """Processes of pip, once there were so many."""
    file = home / "pips"
    wait_for(lambda: file.exists() and len(file.read_text().split()) >= count, "pip runs", 20.0)
    return list(map(int, file.read_text().split()))


def test_one_installs_at_a_time_and_who_comes_second_finds_it_done(home: Path, installs: list[str]) -> None:
    root = home / ".local/share/handfast"
    with open(root / ".lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        two = [install(installs), install(installs)]
        with pytest.raises(subprocess.TimeoutExpired):
            two[0].wait(0.5)
        assert not (home / "pips").exists()
    assert [answered(each) for each in two] == [{"ok": None, "blob": 0}] * 2
    assert (root / "versions/1-aa/.complete").exists()
    assert len(pips(home, 1)) == 1


def test_an_installation_that_nobody_waits_for_ends_with_what_it_started(
    home: Path, installs: list[str]
) -> None:
    (home / "slow").touch()
    with install(installs) as child:
        running = pips(home, 2)
        assert child.stdout is not None
        child.stdout.close()  # as when the connection is lost
        child.wait(timeout=20.0)
    wait_for(lambda: not any(map(is_running, running)), "pip and its child end", 20.0)
    assert not (home / ".local/share/handfast/versions/1-aa/.complete").exists()


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
