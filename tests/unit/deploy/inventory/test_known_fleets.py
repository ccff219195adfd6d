"""Which fleet is meant: of those that run here and those that are up on hosts."""

from __future__ import annotations

import os
from itertools import count
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import hosts, registry
from handfast.deploy.inventory.known_fleets import (
    NotRunningError,
    SeveralError,
    find,
    known,
    meant,
    running_fleet,
)
from handfast.deploy.inventory.registry import Registration
from tests.unit.agent.fleet.test_hosts import fleet as two

_ports = count(9000, 10)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Empty folders instead of the user's."""
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: private)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return private


def a_run(tmp_path: Path, name: str, folder: str, source: Path | None = None) -> Registration:
    path = tmp_path / folder
    path.mkdir()
    text = (
        (FLEETS / "pair.toml").read_text().replace('"pair"', f'"{name}"').replace("7650", str(next(_ports)))
    )
    (path / "fleet.toml").write_text(text)
    return Registration(name, path, path / "fleet.toml", source)


def a_file(path: Path, fleet: Fleet) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(tomli_w.dumps(to_dict(fleet)))
    return path


def brought_up(path: Path, fleet: Fleet) -> Path:
    """The file of a fleet that is noted to be up."""
    registry.note_up(fleet, a_file(path, fleet), [host.name for host in fleet.hosts], complete=True)
    return path


def elsewhere(name: str = "two") -> Fleet:
    """A fleet on other hosts than `two`."""
    tables = '[host.left]\naddress = "10.0.1.1"\n[host.right]\naddress = "10.0.1.2"\n'
    return two(tables, 'host = "left"', 'host = "right"', f'fleet.name="{name}"')


def a_drive(tmp_path: Path, fleet: Fleet, folder: str = "drive") -> Registration:
    file = a_file(tmp_path / folder / "robots.toml", fleet)
    return Registration(fleet.fleet.name, file.parent, file, attached=True)


def test_found_by_name_while_it_lives(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "delta", "b"):
        assert find("pair").fleet_file == tmp_path / "a" / "fleet.toml"
        assert [each.name for each in known()] == ["delta", "pair"]
    assert known() == []


def test_found_by_the_number_of_its_process(tmp_path: Path) -> None:
    pid = str(os.getpid())
    with a_run(tmp_path, "pair", "a"):
        assert find(pid).fleet_file == tmp_path / "a" / "fleet.toml"
        with a_run(tmp_path, pid, "b"):  # a name goes first
            assert find(pid).fleet_file == tmp_path / "b" / "fleet.toml"
    with pytest.raises(NotRunningError, match=f'no fleet of the name "{pid}" runs here'):
        find(pid)


def test_found_by_the_folder_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "pair", "b"):
        assert find(str(tmp_path / "b")).fleet_file == tmp_path / "b" / "fleet.toml"
        assert find("b").fleet_file == tmp_path / "b" / "fleet.toml"
        (tmp_path / "c").mkdir()
        with pytest.raises(NotRunningError, match="no run lives in the folder c; running here: pair"):
            find("c")


def test_a_folder_of_a_fleets_name_does_not_hide_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair").mkdir()
    with a_run(tmp_path, "pair", "a"):
        assert find("pair").fleet_file == tmp_path / "a" / "fleet.toml"


def test_two_of_one_name_are_listed_as_what_means_each(tmp_path: Path) -> None:
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "pair", "b"):
        with pytest.raises(SeveralError) as refused:
            find("pair")
        first, second, *more = str(refused.value).splitlines()[1:]
        assert str(refused.value).startswith("2 fleets of the name pair run here or are up: say which one\n")
        assert not more
        for line, folder in ((first, "a"), (second, "b")):
            assert f"# {tmp_path / folder}, since " in line
            # Both are of this process here: only their folders tell them apart.
            assert find(line.split()[0]).fleet_file == tmp_path / folder / "fleet.toml"
        last = refused.value.text("handfast stop", "or all").splitlines()
        assert last[1].split()[:2] == ["handfast", "stop"]
        assert last[-1] == "or all"
        assert [each.fleet_file.parent.name for each in meant("pair")] == ["a", "b"]


def test_a_fleet_file_means_the_run_of_its_fleet(tmp_path: Path) -> None:
    ours = FLEETS / "pair.toml"
    with a_run(tmp_path, "pair", "a") as first:
        assert find(str(ours)).fleet_file == tmp_path / "a" / "fleet.toml"
        with a_run(tmp_path, "pair", "b"):
            with pytest.raises(SeveralError):
                find(str(ours))
            assert find(str(tmp_path / "b" / "fleet.toml")).fleet_file == tmp_path / "b" / "fleet.toml"
        first.close()
        assert find(str(ours)).fleet_file == ours  # started otherwise: its own addresses and ports


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("pairs", 'no fleet of the name "pairs" runs here; running here: pair ('),
        ("none.toml", "none.toml: there is no such file; running here: pair ("),
        ("no/where", "no/where: there is no such file; running here: pair ("),
    ],
)
def test_nothing_of_the_kind_runs(tmp_path: Path, what: str, says: str) -> None:
    with a_run(tmp_path, "pair", "a"), pytest.raises(NotRunningError) as refused:
        find(what)
    assert str(refused.value).startswith(says)


def test_a_pipe_is_no_fleet(tmp_path: Path) -> None:
    """Nor is it read: nobody may ever write into it."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NotRunningError, match=": it is neither a file nor a folder"):
        find(str(tmp_path / "pipe"))


def test_a_bundled_fleet_that_runs_elsewhere_is_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that `handfast drive pair --detach` has left to drive alone."""
    assert find("pair").fleet_file == FLEETS / "pair.toml"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair").mkdir()
    assert find("pair").fleet_file == FLEETS / "pair.toml"
    with a_run(tmp_path, "pair", "a"):
        assert find("pair").fleet_file == tmp_path / "a" / "fleet.toml"


def test_hosts_of_a_running_fleet_have_their_addresses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def address_of(host: HostSection) -> str:
        return {"left": "10.0.0.7"}[host.name]

    monkeypatch.setattr(hosts, "address_of", address_of)
    path = tmp_path / "fleet.toml"
    text = (FLEETS / "pair.toml").read_text().replace("[[robot]]", '[[robot]]\nhost = "left"')
    path.write_text(text + "[host.left]\n")
    assert running_fleet(str(path)).agent_endpoint(1) == "tls/10.0.0.7:7650"


def test_a_fleet_on_hosts_is_not_a_run_here_that_has_its_name(tmp_path: Path) -> None:
    ours = tmp_path / "on-hosts.toml"
    text = (FLEETS / "pair.toml").read_text().replace("[[robot]]", '[[robot]]\nhost = "left"')
    ours.write_text(text + '[host.left]\naddress = "10.0.0.7"\n')
    with a_run(tmp_path, "pair", "other"):
        assert find(str(ours)).fleet_file == ours
        assert find("pair").fleet_file == tmp_path / "other" / "fleet.toml"
    with a_run(tmp_path, "pair", "own", source=ours):
        assert find(str(ours)).fleet_file == tmp_path / "own" / "fleet.toml"
    with a_run(tmp_path, "pair", "drive") as drive:
        (tmp_path / "drive" / "fleet.toml").write_text(ours.read_text())
        assert find(str(ours)).fleet_file == tmp_path / "drive" / "fleet.toml"
        drive.close()
        assert find(str(ours)).fleet_file == ours


def test_nothing_runs_at_all() -> None:
    with pytest.raises(NotRunningError, match=r'^no fleet of the name "none" runs here; no fleet runs here$'):
        find("none")


# --- fleets on hosts ------------------------------------------------------------------------------


def test_a_fleet_that_was_brought_up_is_known_by_its_name(tmp_path: Path) -> None:
    file = brought_up(tmp_path / "two.toml", two())
    found = find("two")
    assert found.up is not None
    assert found.up.source == str(file)
    assert (found.hosts, found.selector) == (["left", "right"], "two")
    assert found.fleet_file == found.up.fleet_file
    assert running_fleet("two").agent_endpoint(2) == "tls/10.0.0.2:7602"
    assert find(str(file)) == find(str(found.fleet_file)) == found
    file.unlink()
    assert running_fleet("two").agent_endpoint(1) == "tls/10.0.0.1:7600"


def test_one_that_is_driven_is_the_same_fleet(tmp_path: Path) -> None:
    file = brought_up(tmp_path / "two.toml", two())
    with a_drive(tmp_path, two()), a_drive(tmp_path, two(), "second"):
        (only,) = known()
        assert only.up is not None
        assert len(only.runs) == 2
        assert find("two") == find(str(file)) == only
        assert find(str(tmp_path / "drive")).fleet_file == tmp_path / "drive" / "robots.toml"


def test_one_here_and_one_on_hosts_of_one_name(tmp_path: Path) -> None:
    """`handfast run` of the file that is up on its hosts, too: not the one without the other."""
    file = brought_up(tmp_path / "two.toml", two())
    with a_run(tmp_path, "two", "a", source=file):
        for what in ("two", str(file)):
            with pytest.raises(SeveralError) as refused:
                find(what)
            here, hosts = refused.value.fleets
            assert (here.hosts, hosts.hosts) == ([], ["left", "right"])
        assert find(here.selector) == here
        assert find(hosts.selector) == hosts
        assert f"{hosts.selector}  # on left, right, since " in str(refused.value)


def test_two_of_one_name_on_other_hosts(tmp_path: Path) -> None:
    files = [brought_up(tmp_path / "a.toml", two()), brought_up(tmp_path / "b.toml", elsewhere())]
    with pytest.raises(SeveralError) as refused:
        find("two")
    assert {each.selector for each in refused.value.fleets} == set(map(str, files))
    for file, each in zip(files, sorted(refused.value.fleets, key=lambda e: e.about), strict=True):
        assert find(str(file)) == each
    with a_drive(tmp_path, elsewhere()):
        assert [len(find(str(file)).runs) for file in files] == [0, 1]


def test_a_local_file_is_not_a_fleet_on_hosts_of_its_name(tmp_path: Path) -> None:
    brought_up(tmp_path / "pair-on-hosts.toml", elsewhere("pair"))
    ours = FLEETS / "pair.toml"
    assert find(str(ours)).fleet_file == ours
    assert find("pair").hosts == ["left", "right"]
    with a_run(tmp_path, "pair", "a"):
        assert find(str(ours)).fleet_file == tmp_path / "a" / "fleet.toml"


# --- what is damaged ------------------------------------------------------------------------------


def test_a_run_whose_folder_is_gone_says_how_to_stop_it(tmp_path: Path) -> None:
    with a_run(tmp_path, "pair", "a"):
        (tmp_path / "a" / "fleet.toml").unlink()
        (only,) = known()
        assert (only.selector, list(only.robots)) == ("pair", [])
        with pytest.raises(NotRunningError) as refused:
            running_fleet("pair")
    assert "cannot read the fleet file: no such file or directory; pair runs here all the same: " in str(
        refused.value
    )
    assert f"`kill -INT {os.getpid()}`, stops it" in str(refused.value)


def test_what_cannot_be_told_is_said_where_nothing_is_found(tmp_path: Path, folder: Path) -> None:
    brought_up(tmp_path / "two.toml", two())
    record = next((tmp_path / "state").rglob("up.json"))
    record.write_text("{")
    with a_run(tmp_path, "pair", "a"):
        next(folder.iterdir()).write_text("")
        with pytest.raises(NotRunningError) as refused:
            find("two")
    assert f"; the run of process {os.getpid()} cannot be told: " in str(refused.value)
    assert f"; whether two is up on hosts cannot be told: {record} is damaged; when you know" in str(
        refused.value
    )


def test_a_file_whose_fleet_was_renamed_means_what_was_brought_up_from_it(tmp_path: Path) -> None:
    path = brought_up(tmp_path / "two.toml", two())
    a_file(path, elsewhere("renamed"))
    assert [each.name for each in meant(str(path))] == ["two"]
    brought_up(path, elsewhere("renamed"))
    assert [each.name for each in meant(str(path))] == ["renamed"]
    with a_run(tmp_path, "three", "a", tmp_path / "own.toml"):
        own = a_file(tmp_path / "own.toml", elsewhere("four"))
        assert [each.name for each in meant(str(own))] == ["three"]
