"""How every command that drives a fleet begins and ends: findings, folder, verdict, exit status."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from agent.common.wording import printable
from agent.fleet.model import Fleet
from deploy.console.arguments import InputError
from deploy.inventory.folders import out_folder
from deploy.recording.run_files import REPORT_FILE

if TYPE_CHECKING:
    from deploy.report.run_folder import RunFolder
    from deploy.verdict.run_result import RunResult


def run_folder(options: argparse.Namespace, fleet: Fleet, mode: str) -> RunFolder:
    """The new folder that the options name, or one of the fleet's name and the time.

    Raises:
        InputError: it cannot be made.
    """
    from deploy.report.run_folder import RunFolder

    return RunFolder(out_folder(options.out, fleet.fleet.name), fleet, mode)


def refuse_errors(options: argparse.Namespace, fleet: Fleet) -> None:
    """Says what `check` finds wrong.

    Raises:
        InputError: there are errors, and the options do not say to drive all the same.
    """
    from deploy.check.check import check

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
    *,
    interrupted: bool,
    warnings: Sequence[str] = (),
) -> int:
    """Completes the folder, says the verdict, gives the exit status."""
    from deploy.recording.recorder import RecordingError

    try:
        result = folder.finish(reasons, interrupted=interrupted, warnings=warnings, report=options.report)
    except RecordingError as error:
        print(f"handfast: {error}", file=sys.stderr)
        return FAILED
    status = conclude(result, folder.path)
    return INTERRUPTED if interrupted else status


def conclude(result: RunResult, folder: Path) -> int:
    """Says the verdict, why, and the few figures that say how it went; gives the exit status."""
    print("PASSED" if result.passed else "FAILED")
    for reason in result.reasons:
        print(f"  {printable(reason)}")
    for warning in result.warnings:
        print(f"  warning: {printable(warning)}")
    metrics = result.metrics
    settled = metrics["settling_time_s"]
    closest = result.analysis.closest
    error = metrics["final_distance_error_m"]
    print(
        "  formation "
        + (f"within 5 % after {settled:.1f} s" if settled is not None else "not within 5 % at the end")
        + (f", closest {closest.distance_m:.3f} m ({closest.pair[0]}-{closest.pair[1]})" if closest else "")
        + (f", last distance error {error * 1000:.1f} mm" if error is not None else "")
    )
    report = folder / REPORT_FILE
    print(f"  {report if report.exists() else folder}")
    return PASSED if result.passed else FAILED
