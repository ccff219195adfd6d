"""The folder that a run leaves: made at its start, completed at its end, its results made again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import tomli_w

from handfast.agent.common.errors import Error, install
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ingress import Decode
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message
from handfast.agent.messages.validation import Malformed
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.run_files import (
    EVENTS_FILE,
    FLEET_FILE,
    LOG_FOLDER,
    METRICS_FILE,
    RECORDING_FILE,
    RecordingError,
)
from handfast.deploy.report.whole_file import write_events
from handfast.deploy.verdict import metrics
from handfast.deploy.verdict.run_result import RunResult

if TYPE_CHECKING:
    from handfast.deploy.recording.recorder import Recorder

COMPLETING: Final = "recording and metrics.json are being completed, figures and report left out"
COMPLETING_ALL: Final = "recording and metrics.json are being completed"
COMPLETING_METRICS: Final = "metrics.json is being completed, figures and report left out"
LEAVING_OUT: Final = "figures and report are left out"


class FolderError(Error, RuntimeError):
    """The folder cannot be made or written; one line that names it."""


class NotDrawn(RecordingError):
    """Figures or report cannot be written; all else is there.

    Attributes:
        result: what came of the run.
    """

    def __init__(self, why: str, result: RunResult) -> None:
        super().__init__(why)
        self.result = result


def _lacks(what: str, *packages: str) -> str:
    missing = next((name for name in packages if find_spec(name) is None), None)
    return f"{what}: the package {missing} is not installed: {install(missing)}" if missing else ""


class RunFolder:
    """A run's folder and its open recording.

    Attributes:
        lacks: one line that says what the run will not leave because a package is not installed, else empty.

    Args:
        path: made if need be; must be empty.
        fleet: resolved; written as ``fleet.toml``, from which a run's processes read it.
        mode: ``run`` or ``simulate``.

    Raises:
        FolderError: the folder is not empty or cannot be written.
        handfast.deploy.recording.run_files.RecordingError: the recording cannot be opened.
    """

    def __init__(self, path: Path, fleet: Fleet, mode: str) -> None:
        self.path = path
        self.fleet_file = path / FLEET_FILE
        toml = tomli_w.dumps(to_dict(fleet))
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()):
                raise FolderError(f"{path} is not empty: name another folder with --out, or remove it")
            self.fleet_file.write_text(toml, encoding="utf-8")
        except OSError as error:
            raise FolderError(f"cannot write the run's folder {path}: {error.strerror or error}") from None
        self._recorder: Recorder | None = None
        self.lacks = _lacks("there will be no recording and no report", "mcap", "orjson")
        if not self.lacks:
            from handfast.deploy.recording.recorder import Recorder

            self.lacks = _lacks("there will be no report", "matplotlib")
            self._recorder = Recorder(path / RECORDING_FILE, fleet, mode=mode, fleet_toml=toml)
        self._data = RunData(fleet, mode=mode, aside=path)

    def log(self, name: str) -> Path:
        """Path of one process's log."""
        folder = self.path / LOG_FOLDER
        folder.mkdir(exist_ok=True)
        return folder / name

    def record(self, received_ns: int, key: str, payload: bytes, read: Decode = decode) -> Message | None:
        """Records one message as it came; returns it, or None when it is not a valid one.

        Args:
            read: as `decode`, of who has read it already.
        """
        message: Message | None = None
        if self._recorder is not None:
            message = self._recorder.record(received_ns, key, payload, read)
        else:
            with suppress(Malformed):
                message = read(payload)
        if message is not None:
            self._data.feed(received_ns, key, message)
        return message

    def record_message(self, received_ns: int, key: str, message: Message) -> None:
        """Records a message that is decoded already."""
        if self._recorder is not None:
            self._recorder.record_message(received_ns, key, message)
        self._data.feed(received_ns, key, message)

    def close(
        self, reasons: Sequence[str] = (), *, interrupted: bool = False, warnings: Sequence[str] = ()
    ) -> None:
        """Completes the recording with what only the operator knows of the run's end."""
        if self._recorder is None:
            return
        try:
            self._recorder.set_outcome(reasons, interrupted=interrupted, warnings=warnings)
        finally:
            self._recorder.close()

    def finish(
        self,
        reasons: Sequence[str] = (),
        *,
        interrupt: Interrupt | None = None,
        warnings: Sequence[str] = (),
        report: bool = True,
        formats: Sequence[str] = (),
    ) -> RunResult:
        """Completes the recording and writes what comes of it, as `write_result` does.

        Args:
            interrupt: whose first Ctrl-C, if there was one before this, has ended the drive. Another one has
                figures and report left out, be they begun; recording and ``metrics.json`` are complete all
                the same.
            formats: of the figures, besides PNG.

        Raises:
            handfast.deploy.recording.run_files.RecordingError: something cannot be written.
            NotDrawn: that are only figures or report.
        """
        interrupt, report = interrupt or Interrupt(), report and not self.lacks
        before = interrupt.count
        with interrupt.answered(COMPLETING if report else COMPLETING_ALL):
            self.close(reasons, interrupted=before > 0, warnings=warnings)
            recording = self._data.recording(reasons=reasons, interrupted=before > 0, warnings=warnings)
            result = write_result(self.path, RunResult(recording), report=False)
            report = report and not _is_hurried(interrupt, before)
            if report:
                _load()
        if report:
            _draw(self.path, result, formats, interrupt, before)
        return result


def _load() -> None:
    """Loads what draws, where a Ctrl-C raises nothing: a module that is being loaded may swallow it."""
    import handfast.deploy.report.report  # noqa: F401


def _draw(folder: Path, result: RunResult, formats: Sequence[str], interrupt: Interrupt, before: int) -> None:
    """Writes figures and report, or none of them after a Ctrl-C or where one cannot be written."""
    from handfast.deploy.report.report import remove_report, write_report

    try:
        with interrupt.answered(LEAVING_OUT, raises=True):
            if not _is_hurried(interrupt, before):
                write_report(folder, result, formats)
    except KeyboardInterrupt:
        remove_report(folder)
    except RecordingError as error:
        with suppress(RecordingError, OSError):
            remove_report(folder)  # none of them rather than some
        raise NotDrawn(str(error), result) from error


def _is_hurried(interrupt: Interrupt, before: int) -> bool:
    """Whether a Ctrl-C came that has not just ended the drive; `before`: how many had come by its end."""
    return interrupt.count > before or before > 1


def rebuild(folder: Path, formats: Sequence[str] = (), *, interrupt: Interrupt | None = None) -> RunResult:
    """``handfast report RUN``: what comes of a run again, from its recording and ``fleet.toml`` alone, with
    figures in `formats` besides PNG.

    Args:
        interrupt: hears of a Ctrl-C once the recording has been read: figures and report are left out then.

    Raises:
        RecordingError: when the folder holds no run that can be read, or cannot be written.
        FleetError, FormationError: when its fleet file is not valid.
    """
    from handfast.deploy.recording.mcap_reader import read_run  # a run has no need of it

    result, interrupt = RunResult(read_run(folder)), interrupt or Interrupt()
    with interrupt.caught():
        with interrupt.answered(COMPLETING_METRICS):
            write_result(folder, result, report=False)
            _load()
        _draw(folder, result, formats, interrupt, 0)
    return result


def write_result(
    folder: Path, result: RunResult, *, report: bool = True, formats: Sequence[str] = ()
) -> RunResult:
    """Writes ``metrics.json`` and, if asked, figures and report of a run into its folder; returns `result`.

    Raises:
        RecordingError: when something cannot be written.
        FormationError: when the fleet's formation cannot be resolved.
    """
    metrics.write(folder / METRICS_FILE, result.metrics)
    write_events(folder / EVENTS_FILE, result)
    if report:
        # Drawing needs matplotlib, which is slow to load: a run starts without it.
        from handfast.deploy.report.report import write_report

        write_report(folder, result, formats)
    return result
