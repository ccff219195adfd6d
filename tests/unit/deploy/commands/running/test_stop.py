"""`handfast stop` where more than one fleet may be meant."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.transport.bus import BusError
from handfast.deploy.cli import main
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory import registry
from handfast.deploy.inventory.known_fleets import NoAnswerError
from handfast.deploy.inventory.registry import Registration
from handfast.deploy.session.stop import Way


class Stopping:
    """What became of a stop: robot 2 brakes where it is done."""

    def __init__(self, *, done: bool) -> None:
        self.done = done

    def outcomes(self, *, each: bool) -> list[str]:
        assert not each, "nobody has asked for it"
        return [f"robot {robot}: {'stopped' if self.done or robot == 1 else 'silent'}" for robot in (1, 2)]


class Fleets:
    """Runs that live here, each on ports of its own, and what becomes of their stops: by base port."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.outcomes: dict[int, Stopping | Exception] = {}
        self.reasons: dict[int, str] = {}
        self.together: threading.Barrier | None = None
        self._ports = count(9000, 10)

    def run(self, name: str, folder: str, outcome: Stopping | Exception) -> Registration:
        path, port = self.folder / folder, next(self._ports)
        path.mkdir()
        text = (FLEETS / "pair.toml").read_text().replace('"pair"', f'"{name}"').replace("7650", str(port))
        (path / "fleet.toml").write_text(text)
        self.outcomes[port] = outcome
        return Registration(name, path, path / "fleet.toml")

    def stop(self, fleet: Fleet, reason: str, ways: Sequence[Way]) -> tuple[Stopping, list[str]]:
        for way in ways:
            way.close()
        if self.together is not None:
            self.together.wait(20.0)
        self.reasons[fleet.network.base_port] = reason
        outcome = self.outcomes[fleet.network.base_port]
        if isinstance(outcome, Exception):
            raise outcome
        return outcome, []


@pytest.fixture
def fleets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleets:
    (tmp_path / "private").mkdir()
    monkeypatch.setattr(registry, "private_folder", lambda: tmp_path / "private")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    found = Fleets(tmp_path)
    monkeypatch.setattr("handfast.deploy.session.stop.stop", found.stop)
    return found


def test_two_of_one_name_it_says_how_to_stop_each_and_all(
    fleets: Fleets, capsys: pytest.CaptureFixture[str]
) -> None:
    with fleets.run("pair", "a", Stopping(done=True)), fleets.run("pair", "b", Stopping(done=True)):
        assert main(["stop", "pair"]) == 2
        out, err = capsys.readouterr()
        first, *each, last = err.splitlines()
        assert out == ""
        assert first == "handfast: 2 fleets of the name pair run here or are up: say which one"
        assert last == "or stop them all: handfast stop pair --all"
        assert fleets.reasons == {}
        for line in each:  # what it says works
            assert main(line.partition("  # ")[0].split()[1:]) == 0
        assert sorted(fleets.reasons) == [9000, 9010]


def test_all_are_stopped_side_by_side_and_each_is_told(
    fleets: Fleets, capsys: pytest.CaptureFixture[str]
) -> None:
    fleets.together = threading.Barrier(4)
    with (
        fleets.run("pair", "a", Stopping(done=True)),
        fleets.run("pair", "b", Stopping(done=False)),
        fleets.run("pair", "c", NoAnswerError("it does not answer")),
        fleets.run("pair", "d", BusError("no bus")),
        fleets.run("other", "e", Stopping(done=True)),
    ):
        assert main(["stop", "pair", "--all", "--reason", "lunch"]) == 1
    assert fleets.reasons == dict.fromkeys((9000, 9010, 9020, 9030), "lunch")
    out, err = capsys.readouterr()
    assert err == ""
    told = {part.splitlines()[0].split(",")[0]: part.splitlines()[1:] for part in out.split("pair (")[1:]}
    assert told == {
        f"{fleets.folder / 'a'}": ["  robot 1: stopped", "  robot 2: stopped"],
        f"{fleets.folder / 'b'}": ["  robot 1: stopped", "  robot 2: silent"],
        f"{fleets.folder / 'c'}": ["  NOT stopped: it does not answer"],
        f"{fleets.folder / 'd'}": ["  NOT stopped: no bus"],
    }


def test_all_without_a_name_are_all(fleets: Fleets, capsys: pytest.CaptureFixture[str]) -> None:
    with fleets.run("pair", "a", Stopping(done=True)), fleets.run("other", "b", Stopping(done=True)):
        assert main(["stop", "--all"]) == 0
        assert sorted(fleets.reasons) == [9000, 9010]
        (fleets.folder / "b" / "fleet.toml").unlink()
        assert main(["stop", "--all"]) == 1
        assert "  NOT stopped: " in capsys.readouterr().out
    assert main(["stop", "--all"]) == 2
    assert capsys.readouterr().err == "handfast: no fleet runs here, and none is up: nothing to stop\n"


def test_one_of_which_nothing_is_known_is_named(fleets: Fleets, capsys: pytest.CaptureFixture[str]) -> None:
    with fleets.run("pair", "a", Stopping(done=True)):
        next((fleets.folder / "private").iterdir()).write_text("{")
        with fleets.run("other", "b", Stopping(done=True)):
            for arguments, status in ((["other"], 0), (["--all"], 1)):
                assert main(["stop", *arguments]) == status
                assert "handfast: the run of process " in capsys.readouterr().err
        assert main(["stop", "--all"]) == 1


def test_without_a_name_nothing_is_stopped(fleets: Fleets, capsys: pytest.CaptureFixture[str]) -> None:
    with fleets.run("pair", "a", Stopping(done=True)):
        assert main(["stop"]) == 2
    assert capsys.readouterr().err == (
        "handfast: stop: which fleet? Give its name, or --all; `handfast status` shows all\n"
    )
    assert fleets.reasons == {}


def test_cut_short_it_says_that_robots_may_drive_on(
    fleets: Fleets, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(_: Fleet, __: str, ways: Sequence[Way]) -> None:
        for way in ways:
            way.close()
        raise KeyboardInterrupt

    with fleets.run("pair", "a", Stopping(done=True)):
        monkeypatch.setattr("handfast.deploy.session.stop.stop", cut)
        assert main(["stop", "pair"]) == 130
    assert "interrupted: robots may drive on" in capsys.readouterr().err
