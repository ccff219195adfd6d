"""The folder of a run: what is in it, also after Ctrl-C."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from handfast.agent.messages.codec import encode
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.recording.recorder import Recorder
from handfast.deploy.recording.run_files import RecordingError
from handfast.deploy.report import figures, report
from handfast.deploy.report.run_folder import NotDrawn, RunFolder, rebuild
from handfast.deploy.verdict import metrics
from tests.unit.deploy.synthetic_run import in_formation, make_fleet, messages

COMPLETE = {"events.txt", "fleet.toml", "metrics.json", "run.mcap"}
PAIR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)])


@pytest.fixture
def interrupt() -> Iterator[Interrupt]:
    with Interrupt().caught() as caught:
        yield caught


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    made = RunFolder(tmp_path / "run", PAIR, "run")
    for received_ns, key, message in messages(PAIR, in_formation(PAIR)):
        made.record(received_ns, key, encode(message))
    return made


def files(folder: RunFolder) -> set[str]:
    return {path.name for path in folder.path.iterdir()}


def interrupting(do: Callable[..., object]) -> Callable[..., object]:
    """Somebody presses Ctrl-C as this is done."""

    def then(*arguments: object, **named: object) -> object:
        signal.raise_signal(signal.SIGINT)
        return do(*arguments, **named)

    return then


def is_complete(folder: RunFolder) -> bool:
    """Whether metrics.json is that of the whole recording."""
    written = json.loads((folder.path / "metrics.json").read_text())
    again = rebuild(folder.path).metrics
    return bool(written["messages"] == again["messages"]) and "verdict" in written


def test_a_folder_has_figures_and_report(folder: RunFolder, interrupt: Interrupt) -> None:
    folder.finish(interrupt=interrupt)
    assert files(folder) > COMPLETE | {"report.html", "distances.png"}


def test_a_drive_that_was_interrupted_has_them_too(folder: RunFolder, interrupt: Interrupt) -> None:
    signal.raise_signal(signal.SIGINT)
    result = folder.finish(interrupt=interrupt)
    assert result.recording.interrupted
    assert "report.html" in files(folder)


def test_a_ctrl_c_while_figures_are_drawn_leaves_them_out(
    folder: RunFolder,
    interrupt: Interrupt,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    drawn = {name: draw for name, draw in figures.PICTURES.items() if name != "forces"}
    forces = interrupting(figures.PICTURES["forces"])
    monkeypatch.setattr(figures, "PICTURES", {**drawn, "forces": forces})
    result = folder.finish(interrupt=interrupt)
    assert capfd.readouterr().err == "SIGINT: figures and report are left out\n"
    assert files(folder) == COMPLETE, "and none of those that were drawn before"
    assert not result.recording.interrupted, "the drive was not"
    assert interrupt.count == 1
    monkeypatch.undo()
    assert is_complete(folder)


def test_figures_that_cannot_be_written_cost_neither_result_nor_recording(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Figure:
        raise RecordingError("cannot write forces.png: No space left on device")

    monkeypatch.setattr(figures, "PICTURES", figures.PICTURES | {"forces": full})
    with pytest.raises(NotDrawn, match=r"cannot write forces\.png: No space") as error:
        folder.finish()
    assert error.value.result.passed
    assert files(folder) == COMPLETE, "and none of those that were drawn before"
    monkeypatch.undo()
    assert is_complete(folder)


@pytest.mark.parametrize("before", [0, 1])
def test_one_while_the_recording_is_completed_is_answered_and_leaves_them_out(
    folder: RunFolder,
    interrupt: Interrupt,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    before: int,
) -> None:
    for _ in range(before):
        signal.raise_signal(signal.SIGINT)
    monkeypatch.setattr(Recorder, "close", interrupting(Recorder.close))
    monkeypatch.setattr(metrics, "write", interrupting(metrics.write))
    folder.finish(interrupt=interrupt)
    said = "SIGINT: recording and metrics.json are being completed, figures and report left out\n"
    assert capfd.readouterr().err == said * 2
    assert files(folder) == COMPLETE
    monkeypatch.undo()
    assert is_complete(folder)


def test_who_presses_it_twice_waits_for_no_figures(
    folder: RunFolder, interrupt: Interrupt, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)
    monkeypatch.delattr(report, "write_report")
    folder.finish(interrupt=interrupt)
    assert files(folder) == COMPLETE
