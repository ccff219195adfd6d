"""The conversation with a host, with a `ssh` that runs its command on this machine."""

from __future__ import annotations

import errno
import os
import resource
import shlex
import stat
import sys
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.hosts import connection, remote_program
from handfast.deploy.hosts.connection import HostConnection, HostError

HOST = HostSection("rover1", "10.0.0.1")
FAKE = """#!/bin/sh
# As sshd does: the last argument goes to the user's login shell.
for last; do :; done
exec %s -c "$last"
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Makes ``ssh`` mean this machine, with a home of its own; the home."""
    tools, home = tmp_path / "tools", tmp_path / "home"
    tools.mkdir()
    home.mkdir()
    (tools / "python3").symlink_to(sys.executable)
    say(tools, FAKE % "/bin/sh")
    monkeypatch.setenv("PATH", f"{tools}:/usr/bin:/bin")
    monkeypatch.setenv("HOME", str(home))
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    return home


def connect(host: HostSection = HOST) -> None:
    with HostConnection(host) as there:
        assert there.about


def say(tools: Path, text: str) -> None:
    ssh = tools / "ssh"
    ssh.write_text(text)
    ssh.chmod(0o755)


def test_nothing_is_asked_before_what_it_is_there_for(here: Path, monkeypatch: pytest.MonkeyPatch):
    """A stop would wait for it."""
    asked: list[str] = []
    plain = HostConnection.ask

    def ask(self: HostConnection, what: str, **about: Any) -> Any:
        asked.append(what)
        return plain(self, what, **about)

    monkeypatch.setattr(HostConnection, "ask", ask)
    with HostConnection(HOST) as there:
        assert asked == []
        assert there.about == there.about
    assert asked == ["hello"]


def test_an_ssh_that_cannot_be_started_is_said(monkeypatch: pytest.MonkeyPatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(connection.subprocess, "Popen", full)
    with pytest.raises(HostError, match=r"^this computer cannot start ssh: too many open files$"):
        HostConnection(HOST)


def test_it_says_what_the_computer_is(here: Path):
    with HostConnection(HOST) as connection:
        about = connection.about
        assert about["python"] == list(sys.version_info[:3])
        assert about["root"] == str(here / ".local/share/handfast")
        assert about["free_bytes"] > 0
        clock = connection.clock()
        assert abs(clock.offset_s) <= clock.error_s + 0.001


@pytest.mark.parametrize("shell", ["/bin/sh", "/bin/bash"])
def test_a_login_that_prints_does_not_disturb(here: Path, shell: str):
    tools = here.parent / "tools"
    say(tools, (FAKE % shell).replace("exec", "echo welcome; echo to; printf this; exec"))
    with HostConnection(HOST) as connection:
        assert connection.ask("clock") > 0


def test_files_are_put_whole_and_only_within_the_folder(here: Path):
    data = os.urandom(3_000_000)
    with HostConnection(HOST) as connection:
        connection.exchange("put", data, path="fleets/a/x.bin")
        there = here / ".local/share/handfast/fleets/a/x.bin"
        assert there.read_bytes() == data
        assert stat.S_IMODE(there.stat().st_mode) == 0o600
        assert stat.S_IMODE(there.parent.stat().st_mode) == 0o700
        part_of = {"path": "fleets/a/x.bin", "offset": 1_000_000, "most": 10}
        _, part = connection.exchange("get", None, data_bytes=10, **part_of)
        assert part == data[1_000_000:1_000_010]
        for path in ("../x", "/etc/x", "fleets/../../x"):
            with pytest.raises(HostError, match="is not within"):
                connection.exchange("put", b"", path=path)
        assert [p.name for p in there.parent.iterdir()] == ["x.bin"]


def test_what_is_here_already_is_told_by_its_hash(here: Path):
    with HostConnection(HOST) as connection:
        connection.exchange("put", b"abc", path="a")
        digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        assert connection.ask("missing", paths={"a": digest, "b": digest}) == ["b"]
        connection.exchange("put", b"abd", path="a")
        assert connection.ask("missing", paths={"a": digest}) == ["a"]


def test_errors_there_are_one_line_here_and_the_conversation_goes_on(here: Path):
    with HostConnection(HOST) as connection:
        with pytest.raises(HostError, match="no such file or directory"):
            connection.exchange("get", None, path="none")
        with pytest.raises(HostError, match="KeyError"):
            connection.ask("nonsense")
        assert connection.ask("clock") > 0


def test_no_python_that_will_do(here: Path):
    tools = here.parent / "tools"
    (tools / "python3").unlink()
    (tools / "python3").write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.2\nexit 1\n')
    (tools / "python3").chmod(0o755)
    os.environ["PATH"] = str(tools)
    (tools / "head").symlink_to("/usr/bin/head")
    with pytest.raises(HostError, match=r"there is no Python of 3\.11 or later .*python3 is Python 3\.9\.2"):
        connect()


def test_what_was_said_before_the_end_is_the_reason(here: Path, monkeypatch: pytest.MonkeyPatch):
    """The program there may be gone before all of ours is written."""
    say(
        here.parent / "tools",
        f"#!/bin/sh\nexec <&-; echo '{connection.NO_PYTHON}: python3 is Python 3.9.2;'",
    )
    program = here / "program"
    program.write_bytes(b"#" * 1_000_000)  # more than a pipe takes
    monkeypatch.setattr(connection, "PROGRAM", program)
    with pytest.raises(HostError, match=r"there is no Python of 3\.11 or later"):
        connect()


def test_what_ssh_says_is_the_reason(here: Path):
    say(here.parent / "tools", "#!/bin/sh\necho 'x: Permission denied (publickey).' >&2; exit 255\n")
    with pytest.raises(HostError, match="it does not let you in"):
        connect()


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("echo 'sh: Permission denied' >&2; exit 126", r"^the program there ended \(status 126\): sh: Perm"),
        ("exit 0", r"^the program there ended \(status 0\)$"),
        ("exec >&-; exec 2>&-; sleep 60", "^the connection to it was lost$"),
    ],
)
def test_a_program_there_that_ends_is_not_taken_for_ssh(
    here: Path, monkeypatch: pytest.MonkeyPatch, script: str, why: str
):
    monkeypatch.setattr(connection, "END_S", 0.2)
    say(here.parent / "tools", f"#!/bin/sh\n{script}\n")
    with pytest.raises(HostError, match=why):
        connect()


@pytest.mark.parametrize(
    "answer",
    ['{"ok": 1, "blob": 99999999999}', '{"ok": 1, "blob": -1}', "[1]", "x", '{"blob": {}}', "[" * 9999],
)
def test_an_answer_that_is_none_ends_the_conversation(here: Path, answer: str):
    text = f"echo; printf %s {shlex.quote(remote_program.GREETING.decode())}; echo '{answer}'; exit 0"
    say(here.parent / "tools", f"#!/bin/sh\n{text}\n")
    with pytest.raises(HostError, match=r"its answer to hello (makes no sense|has 99999999999 bytes)"):
        connect()


def test_a_host_does_not_choose_how_much_memory_its_answer_takes(here: Path):
    """Tens of MB of JSON without an end; what it stands for would take GB."""
    (here / "flood.py").write_text(
        "import sys\n"
        f"sys.stdout.write({remote_program.GREETING.decode()!r} + '{{\"ok\": [')\n"
        "while True:\n"
        "    sys.stdout.write('[],' * 100_000)\n"
    )
    say(here.parent / "tools", f"#!/bin/sh\necho\nexec {sys.executable} {here}/flood.py\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(HostError, match="its answer to hello is longer than 81920 bytes"):
        connect()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


@pytest.mark.parametrize("answer", ["null", '"now"', "-1", "1.5", "true", "1" * 4000])
def test_a_clock_that_tells_nonsense(here: Path, answer: str):
    text = f"echo; printf %s {shlex.quote(remote_program.GREETING.decode())}; echo '{{\"ok\": {{}}}}'; "
    text += f"echo '{{\"ok\": {answer}}}'; sleep 60"
    say(here.parent / "tools", f"#!/bin/sh\n{text}\n")
    with HostConnection(HOST) as connection, pytest.raises(HostError, match="does not say what time it is"):
        connection.clock()


def test_no_ssh_at_all(here: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(here))
    with pytest.raises(HostError, match="there is no ssh on this machine"):
        connect()


def test_a_host_that_falls_silent_is_given_up(here: Path):
    with HostConnection(HOST) as connection:
        # A request whose data never comes keeps the other end waiting.
        connection._write(b'{"do": "put", "path": "a", "blob": 1000}\n')
        with pytest.raises(HostError, match="did not answer within 1 s"):
            connection._next(1.0)


def test_a_connection_that_is_cut_is_told(here: Path):
    with HostConnection(HOST) as connection:
        connection.abort()
        with pytest.raises(HostError, match="the connection to it was lost"):
            connection.ask("clock")
