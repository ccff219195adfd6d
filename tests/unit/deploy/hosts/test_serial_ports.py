"""What runs on a robot's computer for its vehicle: a look at ports."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from handfast.agent.fleet.hosts import HostSection
from handfast.deploy.hosts.connection import HostConnection
from handfast.deploy.hosts.remote_program import group_name, manager_groups, port
from tests.unit.deploy.hosts.test_remote_program import home as home


@pytest.fixture
def terminal() -> str:
    """A port."""
    return os.ttyname(os.openpty()[1])


def process(proc: Path, number: int, name: str, *words: str, groups: str = "") -> None:
    folder = proc / str(number)
    folder.mkdir(parents=True)
    (folder / "comm").write_text(f"{name}\n")
    (folder / "cmdline").write_bytes("\0".join(words).encode() + b"\0")
    (folder / "status").write_text(f"Name:\t{name}\nGid:\t7\t7\t7\t7\nGroups:\t{groups} \n")


def test_a_port_that_is_well_has_nothing_to_tell(terminal: str, tmp_path: Path) -> None:
    assert port(terminal, proc=str(tmp_path)) == {}


def test_one_that_this_user_may_not_open(
    terminal: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    os.chmod(terminal, 0o600)
    assert port(terminal, proc=str(tmp_path)) == {"denied": ""}
    os.chmod(terminal, 0o660)
    group = group_name(os.stat(terminal).st_gid)
    assert port(terminal, proc=str(tmp_path)) == {"denied": group}


def test_units_have_the_groups_of_when_the_users_systemd_began(
    terminal: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    os.chmod(terminal, 0o660)
    group = os.stat(terminal).st_gid
    process(tmp_path, 1, "systemd", "/sbin/init")
    assert manager_groups(str(tmp_path)) is None
    process(tmp_path, 20, "systemd", "/lib/systemd/systemd", "--user", groups="4 24")
    assert manager_groups(str(tmp_path)) == {4, 7, 24}
    uid = os.stat(tmp_path).st_uid
    monkeypatch.setattr(os, "getuid", lambda: uid + 1000)
    assert port(terminal, proc=str(tmp_path)) == {}, "somebody else's systemd"
    os.chown(tmp_path / "20", uid + 1000, -1)
    assert port(terminal, proc=str(tmp_path)) == {"late": group_name(group)}
    (tmp_path / "20/status").write_text(f"Gid:\t7\nGroups:\t{group}\n")
    assert port(terminal, proc=str(tmp_path)) == {}


@pytest.mark.usefixtures("home")
def test_it_needs_nothing_installed(terminal: str) -> None:
    with HostConnection(HostSection("rover1", "10.0.0.1")) as host:
        assert host.ask("ports", paths=[terminal]) == {terminal: {}}
