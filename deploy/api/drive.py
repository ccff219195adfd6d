"""Drives a fleet, in virtual time or with processes on this machine, to a `Recording`."""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from io import StringIO
from pathlib import Path
from tempfile import SpooledTemporaryFile, gettempdir
from typing import IO, Final, Unpack

import msgpack

from handfast.agent.common.errors import Error, packages_named
from handfast.deploy.api.fleet import Changes, Source, load, names_known, refuse_errors, refuse_overload
from handfast.deploy.api.recording import Recording
from handfast.deploy.api.values import a_path, flags, in_words_of_python, own_classes
from handfast.deploy.inventory.own_orders import out_folder, refuse_full
from handfast.deploy.recording.collector import RunData
from handfast.deploy.verdict.run_result import RunResult

Progress = bool | Callable[[float], object] | None
"""How far it has come: a function that is told the share that is done, 0 to 1; or True: a line on stderr."""
_SPOOL_BYTES: Final = 1 << 26


class _Spool:
    """Messages in the order in which they came: in memory, or in a file without a name when they are many."""

    def __init__(self) -> None:
        self._file: IO[bytes] = SpooledTemporaryFile(_SPOOL_BYTES)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._pack = msgpack.Packer().pack

    def append(self, received_ns: int, key: str, payload: bytes) -> None:
        self._file.write(self._pack((received_ns, key, payload)))

    def __iter__(self) -> Iterator[tuple[int, str, bytes]]:
        self._file.seek(0)
        yield from msgpack.Unpacker(self._file, use_list=False)


@names_known
@packages_named("handfast.simulate")
def simulate(
    fleet: Source,
    changes: Mapping[str, object] | None = None,
    *,
    out: str | Path | None = None,
    report: bool = True,
    check: bool = True,
    progress: Progress = None,
    **named: Unpack[Changes],
) -> Recording:
    """Drives a fleet in virtual time: the same agents as with processes, and the same every time.

    Args:
        fleet, changes, named: as `load` takes them; `law` and `plant` may be classes of one's own.
        out: writes the run's folder too, as `Recording.save` does, with a report unless `report` is False.
        check: refuses a fleet that `check` finds errors in.
        progress: see `Progress`.

    Raises:
        Error: the fleet cannot be loaded or driven, or the folder cannot be written.
    """
    from handfast.deploy.simulate.simulation import Simulation

    flags(report=report, check=check)
    tell = _told(progress)
    target = None if out is None else a_path(out, "out")
    loaded = load(fleet, changes, **named)
    if check:
        refuse_errors(loaded)
    if target is not None:
        with in_words_of_python():
            refuse_full(target)  # now, not when all has been driven
    loaded.register()
    settings, spool = loaded.resolved, _Spool()
    data = RunData(settings, mode="simulate", aside=Path(gettempdir()))

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        spool.append(received_ns, key, payload)
        data.feed(received_ns, key, simulation.decode(payload))

    def so_far(time_s: float) -> bool:
        tell(min(max(time_s / settings.fleet.duration_s, 0.0), 1.0))
        return True

    simulation = Simulation(settings, sink)
    simulation.run(so_far)
    reasons = tuple(simulation.reasons)

    def write(folder: Path, with_report: bool) -> None:
        from handfast.deploy.report.run_folder import RunFolder

        with in_words_of_python():
            written = RunFolder(folder, settings, "simulate")
        for message in spool:
            written.record(*message)
        written.finish(reasons, report=with_report)

    recording = Recording(RunResult(data.recording(reasons=reasons)), None, write)
    if target is not None:
        recording.save(target, report=report)
    return recording


@names_known
@packages_named("handfast.run")
def run(
    fleet: Source,
    changes: Mapping[str, object] | None = None,
    *,
    out: str | Path | None = None,
    report: bool = True,
    check: bool = True,
    progress: bool = False,
    **named: Unpack[Changes],
) -> Recording:
    """Drives a fleet with processes on this machine, in real time, as ``handfast run`` does.

    Ctrl-C stops the robots and ends the processes, and completes the folder, before it is raised.

    Args:
        fleet, changes, named: as `load` takes them. Laws and plants of one's own have to be in a module.
        out: the run's folder (default: ``runs/FLEET-TIME``); must be empty or new.
        report: whether figures and ``report.html`` are made.
        check: refuses a fleet that `check` finds errors in, and one that this machine does not carry.
        progress: shows on stderr what happens.

    Raises:
        Error: the fleet cannot be loaded or driven, or the folder cannot be written.
    """
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.drive.display.live_view import make_view
    from handfast.deploy.drive.local import LocalRun
    from handfast.deploy.processes.placement import place
    from handfast.deploy.report.run_folder import RunFolder

    flags(report=report, check=check, progress=progress)
    target = None if out is None else a_path(out, "out")
    loaded = load(fleet, changes, **named)
    path = (
        _path_handed_on()
        if own_classes(loaded.settings, "robots' processes cannot import")
        else nullcontext()
    )
    if check:
        refuse_errors(loaded)
        refuse_overload(loaded)
    interrupt = Interrupt()
    with interrupt.caught(), path:
        settings, ports, vehicles = place(loaded.resolved)
        try:
            with in_words_of_python():
                folder = RunFolder(out_folder(target, settings.fleet.name), settings, "run")
            if folder.lacks:
                print(f"handfast: {folder.lacks}", file=sys.stderr)
            view = make_view(None if progress else StringIO())
            drive = LocalRun(settings, folder, view, interrupt, vehicles)
            try:
                drive.run()
            except (Error, OSError) as error:
                with suppress(Error):
                    folder.close([str(error)])
                raise Error(str(error)) from None
        finally:
            ports.close()
        result = folder.finish(drive.reasons, interrupt=interrupt, warnings=drive.warnings, report=report)
    if interrupt.count:
        raise KeyboardInterrupt(f"stopped; what was recorded is in {folder.path}")
    return Recording(result, folder.path)


@contextmanager
def _path_handed_on() -> Iterator[None]:
    """Has processes that are started find modules where this one does, such as beside its script."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def _told(progress: Progress) -> Callable[[float], object]:
    if not progress:
        return lambda _: None
    if progress is True:
        return _line
    if not callable(progress):
        raise Error(f"progress must be True, False or a function of the share that is done, got {progress!r}")
    return progress


def _line(share: float) -> None:
    print(f"\r{100.0 * share:3.0f} %", end="\n" if share >= 1.0 else "", file=sys.stderr, flush=True)
