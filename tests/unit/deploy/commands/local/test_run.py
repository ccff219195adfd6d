"""`handfast run` of a fleet whose robots have the same link, each on its own host."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.deploy.cli import main


def test_a_link_that_this_machine_has_once_is_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "rovers_on_hosts"]) == 2
    told = capsys.readouterr()
    assert "robots 1 and 2 both have /dev/serial0, each on its own host: `handfast up`" in told.err
    assert "--set robot_defaults.mavlink.connection=simulator" in told.err
    assert list(tmp_path.iterdir()) == []


def test_one_that_leads_to_many_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As far as what else keeps it from starting."""
    monkeypatch.chdir(tmp_path)

    def placed(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("handfast.deploy.processes.placement.place", placed)
    for connection in ("simulator", "tcp:10.0.0.1:5760"):
        assert (
            main(["run", "rovers_on_hosts", "--set", f"robot_defaults.mavlink.connection={connection}"])
            == 130
        )
