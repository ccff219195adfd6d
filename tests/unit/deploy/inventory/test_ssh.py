"""How a host is logged in to, and what it means when that fails."""

from __future__ import annotations

import subprocess
import sys

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.inventory import ssh
from tests.process.harness import ROOT


def test_what_the_fleet_file_leaves_out_is_left_to_the_configuration():
    words = ssh.command(HostSection("rover1"), "true")
    assert words[0] == "ssh"
    assert words[-3:] == ["--", "rover1", "true"]
    assert "BatchMode=yes" in words, "nobody is there to answer a question"
    assert "StrictHostKeyChecking=yes" in words
    assert not {"-l", "-p", "-i"} & set(words)
    assert not any("HostName" in word for word in words)


def test_what_it_gives_is_given():
    host = HostSection("rover1", "10.0.0.1", None, "robot", 2222, "~/k")
    words = ssh.command(host, "true", accept_new=True)
    assert "HostName=10.0.0.1" in words
    assert words[words.index("-l") + 1] == "robot"
    assert words[words.index("-p") + 1] == "2222"
    assert words[words.index("-i") + 1].startswith("/"), "no shell is there to expand it"
    assert "StrictHostKeyChecking=accept-new" in words
    assert "HostName=fd00::1" in ssh.command(HostSection("a", "[fd00::1]"), "true"), "ssh wants no brackets"


@pytest.mark.parametrize(
    ("said", "meaning"),
    [
        ("ssh: connect to host 10.0.0.9 port 22: Connection timed out", "it does not answer"),
        ("ssh: connect to host a port 22: Connection refused", "no ssh server answers"),
        ("ssh: connect to host a port 22: No route to host", "cannot be reached"),
        ("ssh: Could not resolve hostname rover9: Name or service not known", "give its address"),
        ("robot@10.0.0.1: Permission denied (publickey).", "(ssh-copy-id -o HostName=10.0.0.1 rover1)"),
        ("Warning: Identity file /k not accessible: No such file or directory.\n"
         "robot@10.0.0.1: Permission denied (publickey).", "the key file does not exist"),
        ("@@@\n@   WARNING: UNPROTECTED PRIVATE KEY FILE!   @\nbad permissions\n"
         "robot@10.0.0.1: Permission denied (publickey).", "others may read the key"),
        ("Warning: Identity file /k not accessible: No such file or directory.\n"
         "ssh: connect to host a port 22: Connection timed out", "it does not answer"),
        ("@ WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED! @\nHost key for [10.0.0.7]:2222 has changed "
         "and you have requested strict checking.", "(ssh-keygen -R '[10.0.0.7]:2222')"),
        ("Host key verification failed.", "--accept-new-host-keys, which `up` and `sweep` take"),
        ("No ED25519 host key is known for 10.0.0.1 and you have requested strict checking.\n"
         "Host key verification failed.", "not known yet"),
        ("@@@\n@  WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @\nHost key verification failed.",
         "another computer may pose as it"),
        ("Timeout, server 10.0.0.1 not responding.", "it does not answer"),
        ("client_loop: send disconnect: Broken pipe", "the connection to it was lost"),
        ("something else\nentirely", "ssh: entirely"),
        ("", "the connection to it was lost"),
    ],
)  # fmt: skip
def test_failures_are_told_in_one_line_with_what_to_do(said: str, meaning: str):
    told = ssh.reason(HostSection("rover1", "10.0.0.1"), said)
    assert meaning in told
    assert "\n" not in told


def test_what_is_to_be_typed_reaches_the_host():
    host = HostSection("rover1", "[fd00::1]", None, "robot", 2222, "/my keys/k")
    assert ssh.by_hand(host) == "ssh -o HostName=fd00::1 -p 2222 -i '/my keys/k' robot@rover1"
    assert ssh.by_hand(HostSection("rover1")) == "ssh rover1", "as its configuration says"
    assert "ssh-keygen -R '[fd00::1]:2222')" in ssh.reason(host, "REMOTE HOST IDENTIFICATION HAS CHANGED")


def test_only_ssh_is_read_as_ssh():
    host = HostSection("rover1")
    assert "let you in" in ssh.ended(host, 255, "Permission denied")
    assert ssh.ended(host, 1, "a\nPermission denied") == (
        "the program there ended (status 1): Permission denied"
    )
    assert ssh.ended(host, -9, "anything") == ssh.LOST


def test_a_terminal_is_safe_from_what_a_host_says():
    assert "\x1b" not in ssh.reason(HostSection("a"), "\x1b[31mred")


def test_as_many_files_may_be_open_as_the_user_may_have() -> None:
    """In a process of its own: it holds for all of it."""
    script = (
        "import resource\n"
        "from handfast.deploy.inventory import ssh\n"
        "_, most = resource.getrlimit(resource.RLIMIT_NOFILE)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, most))\n"
        "ssh.allow_many()\n"
        "assert resource.getrlimit(resource.RLIMIT_NOFILE) == (most, most)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)
