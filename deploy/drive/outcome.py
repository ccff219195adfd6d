"""How every command that drives a fleet begins and ends: findings, folder, verdict, exit status."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Final

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.own_orders import out_folder
from handfast.deploy.recording.run_files import REPORT_FILE

if TYPE_CHECKING:
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.report.run_folder import RunFolder
    from handfast.deploy.verdict.run_result import RunResult

EARLY_S: Final = 0.5
"""A drive that ended so long before its time has ended early (`deploy.verdict.missing` says it, too)."""


def run_folder(options: argparse.Namespace, fleet: Fleet, mode: str) -> RunFolder:
    """The new folder that the options name, or one of the fleet's name and the time.

    Raises:
        InputError: it cannot be made.
    """
    from handfast.deploy.report.run_folder import RunFolder

    folder = RunFolder(out_folder(options.out, fleet.fleet.name), fleet, mode)
    if folder.lacks:
        print(f"handfast: {folder.lacks}", file=sys.stderr)
        options.report = False
    return folder


def refuse_errors(options: argparse.Namespace, fleet: Fleet) -> None:
    """Says what `check` finds wrong.

    Raises:
        InputError: there are errors, and the options do not say to drive all the same.
    """
    from handfast.deploy.check.check import check

    findings = [finding for finding in check(fleet) if finding.level in ("error", "warning")]
    for finding in findings:
        if not options.quiet or finding.level == "error":
            print(finding, file=sys.stderr)
    if options.check and any(finding.level == "error" for finding in findings):
        raise InputError(
            f"{options.fleet}: not started because of the errors above (--no-check drives all the same)"
        )


def finish(
    options: argparse.Namespace,
    folder: RunFolder,
    reasons: list[str],
    interrupt: Interrupt,
    *,
    warnings: Sequence[str] = (),
) -> int:
    """Completes the folder, says the verdict, gives the exit status."""
    from handfast.deploy.recording.run_files import RecordingError
    from handfast.deploy.report.run_folder import NotDrawn

    try:
        result = folder.finish(
            reasons, interrupt=interrupt, warnings=warnings, report=options.report, formats=options.figures
        )
    except NotDrawn as error:
        conclude(error.result, folder.path)
        print(f"handfast: {error}; figures and report are left out: {_makes(folder.path)}", file=sys.stderr)
        return FAILED
    except RecordingError as error:
        print(f"handfast: {error}", file=sys.stderr)
        return FAILED
    status = conclude(result, folder.path)
    if options.report:
        say_left_out(folder.path)
    return INTERRUPTED if interrupt.count else status


def say_left_out(folder: Path) -> None:
    """Says that there is no report, where there is none, and how to make it later."""
    if not (folder / REPORT_FILE).exists():
        print(f"  figures and report left out after Ctrl-C: {_makes(folder)}")


def _makes(folder: Path) -> str:
    return f"`handfast report {quote(str(folder))}` makes them"


def conclude(result: RunResult, folder: Path) -> int:
    """Says the verdict, why, and the few figures that say how it went; gives the exit status."""
    print("PASSED" if result.passed else "FAILED")
    for reason in result.reasons:
        print(f"  {printable(reason)}")
    for warning in result.warnings:
        print(f"  warning: {printable(warning)}")
    recording = result.recording
    if recording.epoch_ns is not None and recording.end_s > 0.0:  # else robots stood as they started
        print(f"  {_of_what(result)}{_figures(result)}")
    report = folder / REPORT_FILE
    print(f"  {report if report.exists() else folder}")
    return PASSED if result.passed else FAILED


def _figures(result: RunResult) -> str:
    metrics = result.metrics
    settled = metrics["settling_time_s"]
    closest = result.analysis.closest
    error = metrics["final_distance_error_m"]
    return (
        "formation "
        + (f"within 5 % after {settled:.1f} s" if settled is not None else "not within 5 % at the end")
        + (f", closest {closest.distance_m:.3f} m ({closest.pair[0]}-{closest.pair[1]})" if closest else "")
        + (f", last distance error {error * 1000:.1f} mm" if error is not None else "")
    )


def _of_what(result: RunResult) -> str:
    """Of how much of the drive and of how many robots the figures are, where not of all, to stand before."""
    recording = result.recording
    parts = []
    if recording.end_s < recording.planned_s - EARLY_S:
        parts.append(f"the first {recording.end_s:.1f} s of {recording.planned_s:g} s")
    seen = sum(bool((data.body.t >= 0.0).any()) for data in recording.robots.values())
    if seen < len(recording.ids):
        parts.append(f"{seen} of {len(recording.ids)} robots")
    return f"of {' and '.join(parts)}: " if parts else ""
