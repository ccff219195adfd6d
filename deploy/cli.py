"""The command ``handfast``."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from agent.common.time import NS_PER_S
from agent.fleet.model import FleetError
from agent.runtime.version import handfast_version
from deploy.commands import (
    chaos,
    down,
    drive,
    export_deployment,
    faults,
    fetch,
    heartbeat,
    keys,
    logs,
    new,
    orders,
    preflight,
    resume,
    router,
    signing,
    status,
    stop,
    sweep,
    up,
)
from deploy.console.arguments import InputError, bundled, fleet_arguments, load, load_unresolved
from deploy.console.interrupt import Interrupt, remembered
from deploy.drive.outcome import finish, refuse_errors, run_folder, say_verdict

PASSED, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
ROVER_SIMULATOR: Final = "rover-simulator"
ROVER_PACKAGES: Final = ("pymap3d", "serial")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status (see `--help`)."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        with remembered():
            if arguments[:1] == [ROVER_SIMULATOR]:
                return _rover_simulator(arguments[1:])
            options = _parser().parse_args(arguments)
            result: int = options.command(options)
            sys.stdout.flush()  # here, where it can be told that nobody reads it
            return result
    except (FleetError, InputError) as error:
        print(f"handfast: {error}", file=sys.stderr)
        return BAD_INPUT
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("agent", "plant", "bridges", "deploy"):
            raise
        whose, extra = ("rovers'", "rover") if error.name in ROVER_PACKAGES else ("operator's", "operator")
        print(
            f"handfast: this needs the package {error.name}: install the {whose} extra, "
            f"pip install 'handfast[{extra}]'",
            file=sys.stderr,
        )
        return BAD_INPUT
    except KeyboardInterrupt:
        # One that came up through an `exec`, as of a dataclass that was being made, has `python -m` end
        # with the signal instead of with a status, unless another `exec` comes after it.
        exec("")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output is gone (`handfast check ... | head`): nothing is left to say or flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="handfast",
        description="Drives a group of mobile robots in formation, each on its own.",
        epilog="FLEET is a fleet file (TOML) or the name of a bundled one: "
        f"{', '.join(bundled())}. Exit status: 0 fine; 1 the verdict failed; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("--version", action="version", version=f"handfast {handfast_version()}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, command: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(command=command)
        return sub

    for name, command, text in (
        ("run", _run, "drive the fleet with processes on this machine, and report"),
        ("simulate", _simulate, "drive the fleet in virtual time: fast, and the same every time"),
    ):
        sub = add(name, command, text)
        fleet_arguments(sub)
        sub.add_argument(
            "--out", metavar="DIR", help="the run's folder (default: runs/FLEET-TIME); must be empty or new"
        )
        sub.add_argument(
            "--no-report", dest="report", action="store_false", help="no figures, no report.html"
        )
        sub.add_argument(
            "--no-check", dest="check", action="store_false", help="drive even where `check` finds errors"
        )
        sub.add_argument("--quiet", action="store_true", help="say only what went wrong and the verdict")
    sub = add("check", _check, "say what the fleet will do and all that is wrong with it")
    fleet_arguments(sub)
    preflight.add_parser(commands)
    keys.add_parser(commands)
    router.add_parser(commands)
    up.add_parser(commands)
    status.add_parser(commands)
    logs.add_parser(commands)
    fetch.add_parser(commands)
    down.add_parser(commands)
    export_deployment.add_parser(commands)
    drive.add_parser(commands)
    stop.add_parser(commands)
    resume.add_parser(commands)
    orders.add_parser(commands)
    heartbeat.add_parser(commands)
    faults.add_parser(commands)
    signing.add_parser(commands)
    sweep.add_parser(commands)
    chaos.add_parser(commands)
    # Its options are its own: `main` hands them on before they are looked at here.
    commands.add_parser(ROVER_SIMULATOR, help="an ArduPilot Rover to try bridges with, over UDP and TCP")
    sub = add("report", _report, "rebuild figures, metrics and report of a run from its recording")
    sub.add_argument("folder", metavar="RUN", help="the run's folder")
    sub = add("export", _export, "write a run's data as tables")
    sub.add_argument("folder", metavar="RUN", help="the run's folder")
    sub.add_argument("--format", default="csv", metavar="FORMAT", help="csv (default), parquet or json")
    sub.add_argument("--out", metavar="DIR", help="where to (default: RUN/export)")
    new.add_parser(commands)
    return parser


# ---------------------------------------------------------------------- run and simulate


def _run(options: argparse.Namespace) -> int:
    from agent.runtime.bus import BusError
    from deploy.drive.live_view import make_view
    from deploy.drive.local import LocalRun
    from deploy.processes.placement import place
    from deploy.processes.ports import NoPortsError
    from deploy.recording.recorder import RecordingError

    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load(options)
        refuse_errors(options, fleet)
        try:
            fleet, ports, vehicles = place(fleet)
        except NoPortsError as error:
            raise InputError(str(error)) from None
        folder = run_folder(options, fleet, "run")
        view = make_view(quiet=options.quiet)
        run = LocalRun(fleet, folder, view, interrupt, vehicles)
        try:
            with view:
                run.run()
        except (BusError, RecordingError, OSError) as error:
            print(f"handfast: {error}", file=sys.stderr)
            with suppress(RecordingError):
                folder.close([str(error)])
            return FAILED
        finally:
            ports.close()
        return finish(options, folder, run.reasons, interrupted=interrupt.count > 0)


def _simulate(options: argparse.Namespace) -> int:
    from agent.formation.geometry import resolve
    from deploy.drive.live_view import Watch, make_view
    from deploy.recording.recorder import RecordingError
    from deploy.simulate.simulation import Simulation

    interrupt = Interrupt()
    with interrupt.caught():
        fleet = load(options)
        refuse_errors(options, fleet)
        folder = run_folder(options, fleet, "simulate")
        watch = Watch(fleet, resolve(fleet))
        view = make_view(quiet=options.quiet, period_s=fleet.fleet.duration_s / 10)

        def sink(received_ns: int, key: str, payload: bytes) -> None:
            message = folder.record(received_ns, key, payload)
            if message is not None:
                watch.feed(key, message)

        told = 0

        def progress(time_s: float) -> bool:
            nonlocal told
            for sentence in [*watch.news(time_s), *simulation.reasons[told:]]:
                view.say(sentence)
            told = len(simulation.reasons)
            view.show(watch.picture(time_s))
            return interrupt.count == 0

        begun = time.perf_counter()
        try:
            with view:
                simulation = Simulation(fleet, sink)
                simulation.run(progress)
        except RecordingError as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED
        took = time.perf_counter() - begun
        if not options.quiet:
            driven = max(0.0, (simulation.now_ns - simulation.epoch_ns) / NS_PER_S)
            view.say(f"{driven:.1f} s of driving in {took:.2f} s, {driven / took:.0f} times real time")
        return finish(options, folder, simulation.reasons, interrupted=interrupt.count > 0)


# ---------------------------------------------------------------------- the other commands


def _check(options: argparse.Namespace) -> int:
    from deploy.check.check import check
    from deploy.check.description import describe

    fleet = load_unresolved(options)
    print(describe(fleet))
    findings = check(fleet)
    for finding in findings:
        print(finding)
    return BAD_INPUT if any(finding.level == "error" for finding in findings) else PASSED


def _report(options: argparse.Namespace) -> int:
    from deploy.recording.recorder import RecordingError
    from deploy.report.report import rebuild

    try:
        metrics = rebuild(Path(options.folder))
    except RecordingError as error:
        raise InputError(str(error)) from None
    say_verdict(metrics, Path(options.folder))
    return PASSED if metrics["verdict"]["passed"] else FAILED


def _export(options: argparse.Namespace) -> int:
    from deploy.recording.recorder import RecordingError
    from deploy.report.export import ExportError, export

    try:
        for path in export(Path(options.folder), options.format, Path(options.out) if options.out else None):
            print(path)
    except (RecordingError, ExportError) as error:
        raise InputError(str(error)) from None
    return PASSED


def _rover_simulator(arguments: Sequence[str]) -> int:
    from bridges.mavlink.simulator.__main__ import main as serve

    return serve(arguments)


if __name__ == "__main__":
    sys.exit(main())
