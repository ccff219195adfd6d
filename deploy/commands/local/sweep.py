"""The command ``handfast sweep``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.wording import printable
from handfast.agent.fleet.model import FleetError
from handfast.deploy.console.arguments import (
    change_arguments,
    describe,
    fleet_path,
    fleet_text,
    overrides,
    place_for,
    scenario_path,
)

if TYPE_CHECKING:
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.sweep.folder import SweepFolder
    from handfast.deploy.sweep.plan import Plan, Question
    from handfast.deploy.sweep.run import Resources
    from handfast.deploy.sweep.summary import Cell, Margin

TIMEOUT: Final = "10min"
ROWS_MAX: Final = 40
"""Cells that are printed; of a larger grid, only what its files hold."""
FINDINGS_MAX: Final = 20


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Adds what ``handfast sweep`` takes."""
    describe(
        sub,
        ". Ctrl-C keeps what is done; the same command, or `handfast "
        "sweep DIR`, goes on. Exit status: 0 all runs were driven, whatever came of them; 1 the cluster was "
        "lost before that; 2 bad input; 130 after Ctrl-C.",
    )
    sub.set_defaults(command=sweep)
    sub.add_argument(
        "fleet", metavar="FLEET", help="fleet file, or name of a bundled fleet; or a sweep's folder, to go on"
    )
    sub.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="A.B=V,V,...",
        help="vary a field over these values, repeatedly: all combinations are driven; or A.B=LOW..HIGH: "
        "every run draws it",
    )
    sub.add_argument("--repeat", type=int, metavar="N", help="runs of each cell (default: 1)")
    change_arguments(sub)
    sub.add_argument(
        "--random-starts",
        nargs="?",
        const="",
        metavar="SIDE",
        help="every repeat starts somewhere else, in a square of this side (default: 4m for six robots)",
    )
    sub.add_argument("--margin", metavar="A.B", help="field whose margin is found (default: faults.delay)")
    sub.add_argument("--jobs", type=int, metavar="N", help="runs at a time (default: the number of cores)")
    sub.add_argument(
        "--cluster",
        metavar="WHERE",
        help="drive on the workers of a Dask scheduler: tcp://HOST:PORT, tls://HOST:PORT or its "
        "scheduler file",
    )
    sub.add_argument(
        "--cluster-wait",
        metavar="TIME",
        help="time to wait while the scheduler has no worker (default: 1min)",
    )
    sub.add_argument(
        "--timeout",
        default=TIMEOUT,
        metavar="TIME",
        help=f"real time that a run may take (default: {TIMEOUT})",
    )
    sub.add_argument(
        "--out", type=place_for, metavar="DIR", help="the sweep's folder (default: sweeps/FLEET-TIME)"
    )
    sub.add_argument(
        "--write", type=int, metavar="RUN", help="only write the fleet file of one run, to drive it by itself"
    )
    sub.add_argument(
        "--no-check", dest="check", action="store_false", help="drive even where `check` finds errors"
    )
    sub.add_argument("--quiet", action="store_true", help="say only what went wrong and what was found")


def sweep(options: argparse.Namespace) -> int:
    """Runs the command; returns the exit status."""
    from handfast.deploy.console.interrupt import NOT_STARTED, Interrupt
    from handfast.deploy.console.sources import plugins_of
    from handfast.deploy.inventory.own_orders import out_folder
    from handfast.deploy.simulate.worker_pool import EngineLost, program_digest
    from handfast.deploy.sweep.folder import SweepFolder, read_digest
    from handfast.deploy.sweep.plan import make_plan
    from handfast.deploy.sweep.run import Resources
    from handfast.deploy.sweep.summary import margin_axis

    interrupt = Interrupt()
    with interrupt.caught():
        with interrupt.answered(NOT_STARTED, raises=True):
            wait_s = options.cluster_wait and _quantity(options.cluster_wait, "s", "--cluster-wait", '"2h"')
            timeout_s = _quantity(options.timeout, "s", "--timeout", '"90s" or "10min"')
            resources = Resources(options.cluster, options.jobs, wait_s, timeout_s)
            again, question = _question(options)
            lacking: FleetError | None = None
            try:
                plan = make_plan(question)
            except FleetError as error:
                if again is None or options.write is not None:  # that file would lack the plugins' tables
                    raise
                plan, lacking = make_plan(question, read_digest(again)), error
            margin = margin_axis(plan, options.margin)
            sources = ""
            if lacking is None:
                _refuse_errors(options, plan)
                sources = program_digest(plugins_of(plan.cells))
            path = again or out_folder(options.out, plan.cells[0].fleet.name, "sweeps")
            folder = SweepFolder(path, question, plan, sources)
        with folder:
            if options.write is not None:
                return _write(folder, options.write)
            if lacking is not None and folder.missing:
                raise lacking
            lost = ""
            try:
                _drive(folder, resources, interrupt, options)
            except EngineLost as error:
                lost = str(error)
            if folder.missing:
                return _cut_short(folder, lost, options)
            folder.complete()
            _conclude(folder, margin)
    return PASSED


def _cut_short(folder: SweepFolder, lost: str, options: argparse.Namespace) -> int:
    """Say how to go on with a sweep whose runs are not all done; returns the exit status."""
    given = {"--cluster": options.cluster, "--cluster-wait": options.cluster_wait}
    again = "".join(f" {option} {value}" for option, value in given.items() if value)
    runs = folder.plan.runs
    print(
        f"{lost + ': ' if lost else ''}{runs - len(folder.missing)} of {_counted(runs, 'run')} "
        f"{'is' if runs == 1 else 'are'} done and kept; go on with: handfast sweep {folder.path}{again}",
        file=sys.stderr,
    )
    return FAILED if lost else INTERRUPTED


def _question(options: argparse.Namespace) -> tuple[Path | None, Question]:
    """What is asked, and the folder of the sweep that asks it when one is gone on with."""
    from handfast.deploy.sweep.folder import SWEEP_FILE, read_question
    from handfast.deploy.sweep.plan import Question
    from handfast.deploy.sweep.varied import Axis, Range, SweepError, parse_over

    folder = Path(options.fleet)
    if folder.is_dir():
        if not (folder / SWEEP_FILE).exists():
            raise SweepError(f"{folder} is a folder and holds no sweep: give a fleet, or a sweep's folder")
        names = ("over", "repeat", "law", "overrides", "faults", "duration", "seed", "random_starts", "out")
        given = [name for name in names if getattr(options, name) not in (None, [])]
        if given:
            option = {"overrides": "set", "random_starts": "random-starts"}.get(given[0], given[0])
            raise SweepError(f"{folder} is a sweep that goes on as it was asked: leave --{option} out")
        return folder, read_question(folder)
    path = fleet_path(options.fleet)
    starts = options.random_starts
    if starts:
        starts = _quantity(starts, "m", "--random-starts", '"4m"')
    over = [parse_over(text) for text in options.over]
    return None, Question(
        str(path),
        fleet_text(path, scenario_path(options.faults) if options.faults is not None else None),
        options.law,
        tuple(overrides(options)),
        tuple(each for each in over if isinstance(each, Axis)),
        1 if options.repeat is None else options.repeat,
        0.0 if starts == "" else starts,
        tuple(each for each in over if isinstance(each, Range)),
    )


def _quantity(text: str, unit: str, option: str, example: str) -> float:
    from handfast.deploy.sweep.varied import SweepError, number

    value = number(text, unit)
    if value is None or value <= 0.0:
        raise SweepError(f"{option} must be more than 0 {unit}, such as {example}, got {text!r}")
    return value


def _refuse_errors(options: argparse.Namespace, plan: Plan) -> None:
    """Print what `check` finds in the cells. Errors end the command unless an option says otherwise."""
    from handfast.deploy.sweep.plan import check_cells
    from handfast.deploy.sweep.varied import SweepError

    found = check_cells(plan)
    shown = [each for each in found if each[0].level == "error" or not options.quiet]
    for finding, cells in shown[:FINDINGS_MAX]:
        more = f" and {len(cells) - 1} more" if len(cells) > 1 else ""
        everywhere = len(cells) == len(plan.cells)
        print(finding, "" if everywhere else f"({plan.name(cells[0])}{more})", file=sys.stderr)
    if len(shown) > FINDINGS_MAX:
        print(f"... and {len(shown) - FINDINGS_MAX} more", file=sys.stderr)
    if options.check and any(finding.level == "error" for finding, _ in found):
        raise SweepError(
            f"{options.fleet}: not started because of the errors above (--no-check drives all the same)"
        )


def _write(folder: SweepFolder, run: int) -> int:
    """Writes the fleet file of one run beside the results."""
    import tomli_w

    from handfast.agent.fleet.loading import to_dict
    from handfast.deploy.sweep.varied import SweepError

    plan = folder.plan
    if not 0 <= run < plan.runs:
        raise SweepError(f"--write {run}: the runs of this sweep are 0 to {plan.runs - 1}")
    path = folder.path / f"run-{run}.toml"
    try:
        path.write_text(tomli_w.dumps(to_dict(plan.fleet(run))), encoding="utf-8")
    except OSError as error:
        raise SweepError(f"cannot write {path}: {error.strerror or error}") from None
    print(f"wrote {path} ({plan.run_name(run)}); next: handfast simulate {path}")
    return PASSED


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


# ---------------------------------------------------------------------- driving


def _drive(
    folder: SweepFolder, resources: Resources, interrupt: Interrupt, options: argparse.Namespace
) -> None:
    """Drive the missing runs until all are done or Ctrl-C is pressed."""
    from handfast.deploy.console.progress import make_progress
    from handfast.deploy.console.sources import plugins_of
    from handfast.deploy.simulate.worker_pool import identity
    from handfast.deploy.sweep.run import Runs

    missing, plan = folder.missing, folder.plan
    if not missing:
        return
    done = plan.runs - len(missing)
    if not options.quiet:
        kept = f", {done} of them done already" if done else ""
        where = f"{resources.jobs} at a time" if options.cluster is None else f"on {options.cluster}"
        cells = f"{_counted(len(plan.cells), 'cell')}, {plan.repeat} of each{kept}"
        print(f"{_counted(plan.runs, 'run')} ({cells}), {where}, into {folder.path}", file=sys.stderr)
    progress = make_progress(
        sys.stderr,
        plan.runs,
        done,
        quiet=options.quiet,
        trouble="unsafe or not settled",
        troubled=sum(not row.good for row in folder.rows.values()),
    )
    plugins = plugins_of(plan.cells)
    with progress, resources.engine(Runs(plan), identity(plugins), plugins, progress.say) as engine:
        for row in engine.results(missing, lambda: interrupt.count == 0):
            folder.add(row)
            progress.add(trouble=not row.good)


# ---------------------------------------------------------------------- what was found


def _conclude(folder: SweepFolder, margin: int | None) -> None:
    """Write the summary and the pictures, and print what was found."""
    from handfast.deploy.sweep.figures import write_sweep_figures
    from handfast.deploy.sweep.folder import csv_bytes, replace_file
    from handfast.deploy.sweep.summary import bound_line, margins, summarise, summary_json, summary_table
    from handfast.deploy.sweep.varied import SweepError

    plan = folder.plan
    cells = summarise(plan, folder.rows)
    found = margins(plan, cells, margin) if margin is not None else []
    try:
        replace_file(folder.path / "summary.csv", csv_bytes(summary_table(plan, cells)))
        text = json.dumps(summary_json(plan, cells, found), indent=2, allow_nan=False) + "\n"
        replace_file(folder.path / "summary.json", text.encode())
    except OSError as error:
        raise SweepError(f"cannot write the summary into {folder.path}: {error.strerror or error}") from None
    _, left_out = write_sweep_figures(folder.path, plan, cells, margin, found)
    if len(cells) <= ROWS_MAX:
        _print_table(plan, cells)
    _print_troubles(folder)
    if len(cells) == 1:
        print(bound_line(cells[0]))
    _print_margins(found)
    print("\n".join(filter(None, (left_out, str(folder.path)))))


def _print_table(plan: Plan, cells: Sequence[Cell]) -> None:
    """Print a line for each cell."""
    from handfast.deploy.sweep.summary import shown

    each = shown()
    heads = [f"{one.picture.heading} {one.picture.unit}" for one in each]
    rows = [[*(axis.field for axis in plan.axes), "safe", "settled", *heads]]
    for cell in cells:
        values = [(one, one.value(cell)) for one in each]
        shares = [f"{share.count}/{share.of}" for share in (cell.safe, cell.settled)]
        numbers = ["-" if value is None else one.text(value) for one, value in values]
        rows.append([*cell.values, *shares, *numbers])
    print(_aligned(rows))


def _print_troubles(folder: SweepFolder) -> None:
    """Print how many runs were not finished or ended in fault, with the first of each."""
    from handfast.deploy.verdict.reasons import of_fault

    driven = [folder.rows[run] for run in range(folder.plan.runs)]
    for what, rows in (
        ("were not finished", [row for row in driven if row.settled is None]),
        ("ended with robots in fault", [row for row in driven if of_fault(row.reason)]),
    ):
        if rows:
            print(f"{len(rows)} of {len(driven)} runs {what}; run {rows[0].run}: {printable(rows[0].reason)}")


def _print_margins(found: Sequence[Margin]) -> None:
    for margin in found[:ROWS_MAX]:
        print(f"margin of {margin}")
    if len(found) > ROWS_MAX:
        print(f"... and {len(found) - ROWS_MAX} more margins in summary.json")


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  " + "  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows
    )
