"""A Ctrl-C while `handfast report` draws leaves figures out, and says how to make them later."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from handfast.agent.common.errors import BAD_INPUT, INTERRUPTED, PASSED
from handfast.agent.messages.codec import encode
from handfast.deploy.cli import main
from handfast.deploy.inventory.registry import Registration
from handfast.deploy.report import figures
from handfast.deploy.report.run_folder import RunFolder
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages

PAIR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = RunFolder(tmp_path / "run", PAIR, "run")
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        made.record(received_ns, key, encode(message))
    made.finish(report=False)
    return made.path


def test_a_ctrl_c_leaves_figures_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "metrics.json").unlink()

    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(figures, "PICTURES", {**figures.PICTURES, "forces": interrupted})
        assert main(["report", str(folder)]) == INTERRUPTED
    said = capfd.readouterr()
    assert said.err == "SIGINT: figures and report are left out\n"
    assert f"  figures and report left out after Ctrl-C: `handfast report {folder}` makes them" in said.out
    left = {path.name for path in folder.iterdir()}
    assert left == {"events.txt", "fleet.toml", "run.mcap", "metrics.json"}
    assert main(["report", str(folder)]) == PASSED
    said = capfd.readouterr()
    assert (folder / "report.html").exists()
    assert "left out" not in said.out


def test_a_run_that_is_still_driven_gets_none(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with Registration(PAIR.fleet.name, folder, folder / "fleet.toml"):
        assert main(["report", str(folder)]) == BAD_INPUT
    assert "this run is still being driven" in capfd.readouterr().err
    assert not (folder / "report.html").exists()
    assert main(["report", str(folder)]) == PASSED
