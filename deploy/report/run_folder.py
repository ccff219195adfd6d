"""The folder that a run leaves: made at its start, completed at its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w

from agent.common.errors import Error
from agent.fleet.loading import to_dict
from agent.fleet.model import Fleet
from agent.formation.geometry import resolve
from agent.messages.types import Message
from deploy.recording.collector import RunData
from deploy.recording.recorder import Recorder
from deploy.recording.run_files import FLEET_FILE, LOG_FOLDER, METRICS_FILE, RECORDING_FILE
from deploy.verdict import metrics


class FolderError(Error, RuntimeError):
    """The folder cannot be made or written; one line that names it."""


class RunFolder:
    """A run's folder and its open recording.

    Args:
        path: made if need be; must be empty.
        fleet: resolved; written as ``fleet.toml``, from which a run's processes read it.
        mode: ``run`` or ``simulate``.

    Raises:
        FolderError: the folder is not empty or cannot be written.
        deploy.recording.recorder.RecordingError: the recording cannot be opened.
    """

    def __init__(self, path: Path, fleet: Fleet, mode: str) -> None:
        self.path, self._fleet, self._mode = path, fleet, mode
        self.fleet_file = path / FLEET_FILE
        toml = tomli_w.dumps(to_dict(fleet))
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                raise FolderError(f"{path} is not empty: name another folder with --out, or remove it")
            self.fleet_file.write_text(toml, encoding="utf-8")
        except OSError as error:
            raise FolderError(f"cannot write the run's folder {path}: {error.strerror or error}") from None
        self._recorder = Recorder(path / RECORDING_FILE, fleet, mode=mode, fleet_toml=toml)
        self._data = RunData(fleet, mode=mode, aside=path)

    def log(self, name: str) -> Path:
        """Path of one process's log."""
        folder = self.path / LOG_FOLDER
        folder.mkdir(exist_ok=True)
        return folder / name

    def record(self, received_ns: int, key: str, payload: bytes) -> Message | None:
        """Records one message as it came; returns it, or None when it is not a valid one."""
        message = self._recorder.record(received_ns, key, payload)
        if message is not None:
            self._data.feed(received_ns, key, message)
        return message

    def close(
        self, reasons: Sequence[str] = (), *, interrupted: bool = False, warnings: Sequence[str] = ()
    ) -> None:
        """Completes the recording with what only the operator knows of the run's end."""
        try:
            self._recorder.set_outcome(reasons, interrupted=interrupted, warnings=warnings)
        finally:
            self._recorder.close()

    def finish(
        self,
        reasons: Sequence[str] = (),
        *,
        interrupted: bool = False,
        warnings: Sequence[str] = (),
        report: bool = True,
    ) -> dict[str, Any]:
        """Completes the recording, writes ``metrics.json`` and, if asked, figures and report.

        Returns the metrics.

        Raises:
            deploy.recording.recorder.RecordingError: something cannot be written.
        """
        self.close(reasons, interrupted=interrupted, warnings=warnings)
        recording = self._data.recording(reasons=reasons, interrupted=interrupted, warnings=warnings)
        result = metrics.compute(
            recording,
            self._fleet,
            resolve(self._fleet),
            mode=self._mode,
            seed=self._fleet.fleet.seed,
            reasons=reasons,
        )
        metrics.write(self.path / METRICS_FILE, result)
        if report:
            # Drawing needs matplotlib, which is slow to load: a run starts without it.
            from deploy.report.report import write_report

            write_report(self.path, recording, self._fleet, result)
        return result
