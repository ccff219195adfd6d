"""Finding a fleet that runs on this machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agent.fleet.hosts import HostSection
from deploy.console.data_files import FLEETS
from deploy.inventory import registry, ssh
from deploy.inventory.registry import NotRunningError, Registration, find, running
from deploy.inventory.running import running_fleet


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty private folder instead of the user's."""
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: private)
    return private


def a_run(tmp_path: Path, name: str, folder: str, source: Path | None = None) -> Registration:
    path = tmp_path / folder
    path.mkdir()
    (path / "fleet.toml").write_text((FLEETS / "pair.toml").read_text().replace('"pair"', f'"{name}"'))
    return Registration(name, path, path / "fleet.toml", source)


def test_found_by_name_while_it_lives(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "delta", "b"):
        assert find("pair") == tmp_path / "a" / "fleet.toml"
        assert [run.name for run in running()] == ["delta", "pair"]
        assert str(running()[1]).startswith(f"pair ({tmp_path / 'a'}, since ")
    assert list(folder.iterdir()) == []
    assert running() == []


def test_found_by_the_folder_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with a_run(tmp_path, "pair", "a"), a_run(tmp_path, "pair", "b"):
        assert find(str(tmp_path / "b")) == tmp_path / "b" / "fleet.toml"
        assert find("b") == tmp_path / "b" / "fleet.toml"
        (tmp_path / "c").mkdir()
        with pytest.raises(NotRunningError, match="no run lives in the folder c; running here: pair"):
            find("c")


def test_a_folder_of_a_fleets_name_does_not_hide_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair").mkdir()
    with a_run(tmp_path, "pair", "a"):
        assert find("pair") == tmp_path / "a" / "fleet.toml"


def test_two_of_one_name_are_listed(tmp_path: Path) -> None:
    with (
        a_run(tmp_path, "pair", "a"),
        a_run(tmp_path, "pair", "b"),
        pytest.raises(NotRunningError) as refused,
    ):
        find("pair")
    text = str(refused.value)
    assert text.startswith("2 fleets of the name pair run here: give the folder of one\n")
    assert f"{tmp_path / 'a'} (since " in text
    assert f"{tmp_path / 'b'} (since " in text


def test_a_fleet_file_means_the_run_of_its_fleet(tmp_path: Path) -> None:
    ours = FLEETS / "pair.toml"
    with a_run(tmp_path, "pair", "a") as first:
        assert find(str(ours)) == tmp_path / "a" / "fleet.toml"
        with a_run(tmp_path, "pair", "b"):
            with pytest.raises(NotRunningError, match="2 fleets of the name pair"):
                find(str(ours))
            assert find(str(tmp_path / "b" / "fleet.toml")) == tmp_path / "b" / "fleet.toml"
        first.close()
        assert find(str(ours)) == ours  # started otherwise: its own addresses and ports


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


def test_a_bundled_fleet_that_runs_elsewhere_is_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that `handfast drive pair --detach` has left to drive alone."""
    assert find("pair") == FLEETS / "pair.toml"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pair").mkdir()
    assert find("pair") == FLEETS / "pair.toml"
    with a_run(tmp_path, "pair", "a"):
        assert find("pair") == tmp_path / "a" / "fleet.toml"


def test_hosts_of_a_running_fleet_have_their_addresses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def address_of(host: HostSection) -> str:
        return {"left": "10.0.0.7"}[host.name]

    monkeypatch.setattr(ssh, "address_of", address_of)
    path = tmp_path / "fleet.toml"
    text = (FLEETS / "pair.toml").read_text().replace("[[robot]]", '[[robot]]\nhost = "left"')
    path.write_text(text + "[host.left]\n")
    assert running_fleet(str(path)).agent_endpoint(1) == "tls/10.0.0.7:7650"


def test_a_fleet_on_hosts_is_not_a_run_here_that_has_its_name(tmp_path: Path) -> None:
    ours = tmp_path / "on-hosts.toml"
    text = (FLEETS / "pair.toml").read_text().replace("[[robot]]", '[[robot]]\nhost = "left"')
    ours.write_text(text + '[host.left]\naddress = "10.0.0.7"\n')
    with a_run(tmp_path, "pair", "other"):
        assert find(str(ours)) == ours
        assert find("pair") == tmp_path / "other" / "fleet.toml"
    with a_run(tmp_path, "pair", "own", source=ours):
        assert find(str(ours)) == tmp_path / "own" / "fleet.toml"
    with a_run(tmp_path, "pair", "drive") as drive:
        (tmp_path / "drive" / "fleet.toml").write_text(ours.read_text())
        assert find(str(ours)) == tmp_path / "drive" / "fleet.toml"
        drive.close()
        assert find(str(ours)) == ours


def test_nothing_runs_at_all() -> None:
    with pytest.raises(NotRunningError, match=r'^no fleet of the name "none" runs here; no fleet runs here$'):
        find("none")


def test_what_a_killed_run_left_is_removed(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"):
        entry = next(folder.iterdir())
        text = entry.read_text()
        # A dead process holds no lock, whoever has its number now.
        (folder / "run-1-1.json").write_text(text)
        assert [run.folder for run in running()] == [json.loads(text)["folder"]]
        assert [path.name for path in folder.iterdir()] == [entry.name]


def test_an_entry_of_another_version_is_left_alone(tmp_path: Path, folder: Path) -> None:
    with a_run(tmp_path, "pair", "a"):
        entry = next(folder.iterdir())
        entry.write_text('{"name": "pair"}')
        assert running() == []
        assert entry.exists()
