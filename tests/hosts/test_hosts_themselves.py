"""The test hosts are what the other tests take them for, and nothing of them stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.hosts import spaces
from tests.hosts.computers import NOBODYS_ADDRESS, ROOT
from tests.hosts.host import Host, Setup
from tests.hosts.hosts import Hosts, missing
from tests.process.harness import PATIENCE_S, wait_for

pytestmark = pytest.mark.long

MakeHosts = Callable[[int | Sequence[Setup]], Hosts]


@pytest.fixture(scope="module")
def hosts(make_hosts: MakeHosts) -> Hosts:
    return make_hosts(3)


def remains(name: str) -> list[str]:
    """What there still is of a set of hosts, or of all sets whose name begins so."""
    found = [str(path) for path in Path(tempfile.gettempdir()).glob(f"{name}*")]
    with spaces.control_groups() as groups:
        found += [str(path) for path in groups.glob(f"{name}*")]
    mark = f"{spaces.MARK}={name}".encode()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    found += [line for line in Path("/proc/self/mounts").read_text().splitlines() if name in line]
    return found


def answers(hosts: Hosts, host: Host) -> bool:
    return hosts.operator.ssh(host, "true", "-oConnectTimeout=1").returncode == 0


def start_talker(host: Host, unit: str = "talker", *options: str) -> int:
    """Starts a unit that says a word and waits; gives its process, as this machine counts."""
    script = "echo a word; exec sleep 1000"
    host.run(["systemd-run", "--user", f"--unit={unit}", *options, "sh", "-c", script], check=True)
    return wait_for(lambda: list(host.pids("sleep 1000")), "the unit's process")[0]


def test_the_operator_reaches_each_host_over_ssh(hosts: Hosts) -> None:
    for name, host in [(host.name, host) for host in hosts] + [(hosts[0].address, hosts[0])]:
        done = hosts.operator.ssh(name, "hostname")
        assert (done.stdout, done.returncode) == (f"{host.name}\n", 0), done.stderr


def test_a_host_has_a_python_recent_enough_and_the_operator_the_one_under_test(hosts: Hosts) -> None:
    ask = "import sys, venv; print(sys.version_info >= (3, 11), sys.executable)"
    over_ssh = hosts.operator.ssh(hosts[0], f"python3 -c '{ask}'")
    assert over_ssh.stdout.startswith("True "), over_ssh.stderr
    mine = hosts.operator.run(["python", "-c", f"import numpy; {ask}"])
    assert mine.stdout == f"True {Path(sys.executable)}\n", mine.stderr


def test_homes_and_temporary_folders_are_apart(hosts: Hosts) -> None:
    hosts[0].run("touch mine /tmp/mine", check=True)
    assert (hosts[0].home / "mine").exists()
    assert hosts[1].run("ls ~ /tmp").stdout == "/root:\n\n/tmp:\n"
    hosts.operator.run(["touch", "operators"])
    assert (hosts.operator.home / "operators").exists()
    assert not (Path.home() / "operators").exists()


def test_hosts_reach_each_other_by_name_on_any_port_and_nobody_else(hosts: Hosts) -> None:
    listen = "import socket; s = socket.create_server(('', 7447)); print(s.accept()[0].recv(9))"
    hosts[1].run(["systemd-run", "--user", "--unit=listener", "python3", "-c", listen], check=True)
    wait_for(
        lambda: hosts[0].run("echo hello >/dev/tcp/host2/7447").returncode == 0, "a connection between hosts"
    )
    wait_for(lambda: "hello" in hosts[1].run("journalctl -o cat -t python3").stdout, "what it got")
    refused = hosts[0].run(f"echo >/dev/tcp/{NOBODYS_ADDRESS}/22")
    assert "No route to host" in refused.stderr
    devices = set(os.listdir("/sys/class/net"))
    assert not {device for device in devices if device.startswith(("port", "br0"))}


def test_a_users_unit_runs_logs_and_restarts(hosts: Hosts) -> None:
    first = start_talker(
        hosts[0], "talker", "-pRestart=on-failure", "-pRestartSec=50ms", "-pSyslogIdentifier=parrot"
    )

    def log() -> str:
        found = hosts[0].run("journalctl -o cat -t parrot")
        return found.stdout + found.stderr

    # The journal may lose what a process said that was killed before it had read that, on a busy machine.
    wait_for(lambda: log() == "a word\n", "its word in the log", report=log)
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: set(hosts[0].pids("sleep 1000")) - {first}, "the unit's next process")
    over_ssh = hosts.operator.ssh(hosts[0], "systemctl --user show talker -pNRestarts --value")
    assert over_ssh.stdout == "1\n"
    # By identifier: the journal learns a unit's name from the process, too late when that is gone already.
    wait_for(lambda: log() == "a word\na word\n", "both words in the log", report=log)
    assert "a word" in hosts[0].run("journalctl -o cat --user-unit=talker").stdout
    groups = hosts[0].run("cat /proc/self/cgroup; systemctl --user show talker -pControlGroup --value").stdout
    assert "\n0::/user.slice/user-0.slice/session-1.scope\n" in f"\n{groups}"
    assert groups.endswith("\n/user.slice/user-0.slice/user@0.service/app.slice/talker.service\n")
    with spaces.control_groups() as all_groups:  # the host's own tree, so that it goes with the host
        assert (all_groups / f"{hosts.name}-host1" / "user.slice").exists()
    hosts[0].run("systemctl --user stop talker", check=True)
    assert not hosts[0].pids()


def test_a_cut_host_is_reached_again_when_it_is_back(hosts: Hosts) -> None:
    hosts[1].cut()
    assert not answers(hosts, hosts[1])
    assert answers(hosts, hosts[2])
    hosts[1].restore()
    wait_for(lambda: answers(hosts, hosts[1]), "the host that was cut off")


def test_a_cut_operator_leaves_the_hosts_together(hosts: Hosts) -> None:
    hosts.operator.cut()
    assert not answers(hosts, hosts[1])
    assert hosts[0].run("timeout 5 bash -c 'echo >/dev/tcp/host2/22'").returncode == 0
    hosts.operator.restore()
    wait_for(lambda: answers(hosts, hosts[1]), "a host, by the operator who is back")


def test_a_reboot_kills_all_and_keeps_home_and_journal(hosts: Hosts) -> None:
    host = hosts[2]
    units = host.home / ".config/systemd/user"
    units.mkdir(parents=True)
    unit = "[Service]\nExecStart=sh -c 'echo started; exec sleep 2000'\n[Install]\nWantedBy=default.target\n"
    (units / "enabled.service").write_text(unit)
    host.run("systemctl --user enable enabled.service", check=True)
    killed = start_talker(host)
    boot = host.run("cat /proc/sys/kernel/random/boot_id").stdout
    wait_for(lambda: "a word" in host.run("journalctl -o cat --user-unit=talker").stdout, "the unit's word")
    assert list((host.folder / "log" / "journal").iterdir())  # and not in this machine's /var/log
    host.reboot()
    assert not Path(f"/proc/{killed}").exists()
    assert host.run("cat /proc/sys/kernel/random/boot_id").stdout != boot
    assert "a word" in host.run("journalctl -o cat --user-unit=talker").stdout
    wait_for(lambda: host.pids("sleep 2000"), "the enabled unit")
    assert answers(hosts, host)


def test_a_host_that_is_off_is_not_reached(hosts: Hosts) -> None:
    hosts[2].power_off()
    assert not answers(hosts, hosts[2])
    hosts[2].power_on()
    assert answers(hosts, hosts[2])


def test_a_commands_signals_and_output_are_its_own(hosts: Hosts) -> None:
    script = "trap 'echo asked; exit 3' TERM; echo up; while :; do sleep 0.05; done"
    child = hosts.operator.popen(["sh", "-c", script])
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "up\n"
        assert child.pid in hosts.operator.pids()
        child.terminate()
        assert child.communicate(timeout=PATIENCE_S) == ("asked\n", "")
        assert child.returncode == 3
    finally:
        child.kill()


def test_hosts_with_something_amiss(make_hosts: MakeHosts) -> None:
    hosts = make_hosts(
        [Setup(python="old"), Setup(python="none"), Setup(systemd=False), Setup(home_mb=4, linger=False)]
    )
    old, none, bare, small = hosts
    ask = "python3 -V; python3 -Ic 'import sys; print(sys.version_info < (3, 11))'"
    assert hosts.operator.ssh(old, ask).stdout == "Python 3.9.2\nTrue\n"
    assert hosts.operator.ssh(none, "python3 -V").returncode == 127
    assert hosts.operator.ssh(none, "systemctl --user is-system-running").stdout == "running\n"
    assert hosts.operator.ssh(bare, "systemctl --user is-system-running").stdout == "offline\n"
    small.fill_disk()
    assert small.run("stat -c %s .filling").stdout == f"{4 << 20}\n"
    assert "No space left" in hosts.operator.ssh(small, "echo x >more").stderr
    small.reboot()
    assert small.run("echo x >more").returncode != 0
    small.free_disk()
    assert small.run("echo x >more").returncode == 0
    assert [host.run("ls /var/lib/systemd/linger").stdout for host in (old, small)] == ["root\n", ""]
    bare.wrong_host_key()
    assert "HOST IDENTIFICATION HAS CHANGED" in hosts.operator.ssh(bare, "true").stderr
    old.stop_sshd()
    assert "refused" in hosts.operator.ssh(old, "true").stderr
    old.start_sshd()
    assert answers(hosts, old)


def test_a_host_without_a_good_python_is_lent_the_one_under_test(
    can_have_hosts: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.hosts.host.python_to_lend", lambda: Path(sys.base_prefix))
    with Hosts(1) as hosts:
        ask = "import ensurepip, ssl, sys, venv; print(sys.version)"
        over_ssh = hosts.operator.ssh(
            hosts[0], f"python3 -c '{ask}'; touch $(dirname $(command -v python3))/x"
        )
        assert over_ssh.stdout.strip() == sys.version, over_ssh.stderr
        assert sys.base_prefix.startswith("/usr") or "Read-only" in over_ssh.stderr


def test_two_sets_live_side_by_side_and_one_goes_without_the_other(hosts: Hosts) -> None:
    with Hosts(1) as others:
        others[0].run("touch of_the_others", check=True)
        assert others.operator.ssh(others[0], "ls").stdout == "of_the_others\n"
        assert "of_the_others" not in hosts.operator.ssh(hosts[0], "ls").stdout
        name = others.name
    assert not remains(name)
    assert answers(hosts, hosts[0])


def test_nothing_stays(can_have_hosts: None) -> None:
    with Hosts(2) as hosts:
        start_talker(hosts[0])
        hosts[1].run("nohup sleep 3000 >/dev/null 2>&1 &", check=True)
        left = hosts.operator.popen(["sleep", "4000"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert remains(hosts.name)
    assert left.wait() == -signal.SIGKILL
    assert not remains(hosts.name)


CRASHED = "handfast-crashed-hosts"
"""What names of these hosts begin with: no other test, that makes hosts meanwhile, sweeps them away."""
CRASH = f"""
import os, signal
from tests.hosts import spaces
from tests.hosts.hosts import Hosts
spaces.PREFIX = "{CRASHED}"
hosts = Hosts(1)
hosts[0].run("systemd-run --user sleep 1000", check=True)
hosts.operator.popen(["setsid", "--fork", "sleep", "1000"])
print(hosts.name, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_run_that_was_killed_leaves_nothing_to_the_next(
    can_have_hosts: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HANDFAST_TEST_PROCESS")  # what it leaves is for the next run to find, not for pytest
    crash = subprocess.run([sys.executable, "-c", CRASH], cwd=ROOT, capture_output=True, text=True)
    assert crash.returncode == -signal.SIGKILL, crash.stderr
    name = crash.stdout.strip()
    assert name.startswith(CRASHED)
    assert remains(name)
    monkeypatch.setattr(spaces, "PREFIX", CRASHED)
    spaces.sweep()
    assert not remains(name)


def test_what_is_lacking_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "tests.hosts.hosts.TOOLS", {"ip": "iproute2", "no-such-tool": "nothing", "/no/such": "more"}
    )
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert missing() == "test hosts need the packages more, nothing"
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert missing() == "test hosts need root"
