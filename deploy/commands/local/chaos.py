"""The command ``handfast chaos``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from agent.common.exit import FAILED, INTERRUPTED, PASSED
from agent.common.wording import show
from deploy.console.arguments import (
    InputError,
    accepts_new_keys,
    cluster_wait_s,
    describe,
    engine_arguments,
    place_for,
    refuse_jobs,
)

if TYPE_CHECKING:
    from deploy.chaos.report import Driven
    from deploy.simulate.worker_pool import GoOn

COUNT: Final = 100
OUT: Final = "chaos"
TIMEOUT_S: Final = 900.0
"""Real time that one scenario may take, shrunk and all."""
SEED_MAX: Final = 2**62


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Adds what ``handfast chaos`` takes."""
    describe(
        sub,
        ". In virtual time, on all cores. A scenario is a "
        "fleet file: one that fails is written, and made smaller. Exit status: 0 nothing was violated; 1 "
        "something was; 2 bad input; 130 after Ctrl-C.",
    )
    sub.set_defaults(command=chaos)
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="first seed (default: 0)")
    sub.add_argument(
        "--count", type=int, default=COUNT, metavar="M", help=f"seeds N to N+M-1 (default: {COUNT})"
    )
    sub.add_argument(
        "--profile", metavar="P", help="only seeds of this profile, the first M from N on (docs/chaos.md)"
    )
    sub.add_argument(
        "--real",
        action="store_true",
        help="with real processes, in real time, one after the other",
    )
    sub.add_argument(
        "--routed",
        action="store_true",
        help="with --real: robots are linked to two routers instead of to each other",
    )
    engine_arguments(sub, "scenarios")
    sub.add_argument(
        "--no-shrink",
        dest="shrink",
        action="store_false",
        help="leave failing scenarios as they were drawn",
    )
    sub.add_argument(
        "--out", type=place_for, default=OUT, metavar="DIR", help=f"where failing ones go (default: {OUT})"
    )
    sub.add_argument(
        "--write", action="store_true", help="only write the scenarios of these seeds, as fleet files"
    )
    sub.add_argument("--quiet", action="store_true", help="say only what went wrong and the conclusion")


@dataclass(frozen=True, slots=True)
class Scenarios:
    """The scenario of every seed, as `deploy.simulate.worker_pool.Pool` drives them."""

    shrink: bool

    def execute(self, number: int, go_on: GoOn) -> Driven:
        from deploy.chaos.draw import draw
        from deploy.chaos.report import Driven
        from deploy.chaos.run import drive, scenario_text
        from deploy.chaos.shrink import shrink

        tables = draw(number)
        outcome = drive(scenario_text(tables), go_on)
        small = shrink(tables, outcome, go_on) if self.shrink and outcome.violations else None
        return Driven(number, tables, outcome, small)

    def unfinished(self, number: int, reason: str, wall_s: float, *, timed_out: bool) -> Driven:
        from deploy.chaos.draw import draw
        from deploy.chaos.report import Driven
        from deploy.chaos.run import CRASH, Outcome
        from deploy.verdict.violations import Violation

        failed = Violation(CRASH, 0.0, f"The scenario was not driven to its end: {reason}.")
        return Driven(number, draw(number), Outcome((failed,), wall_s=wall_s))


def chaos(options: argparse.Namespace) -> int:
    """Runs the command; returns the exit status."""
    from deploy.chaos.draw import PROFILES, seeds_of
    from deploy.chaos.report import Tally, conclusion, lines
    from deploy.chaos.run_real import real_results
    from deploy.cluster.choose import check_cluster, make_engine
    from deploy.console.interrupt import Interrupt
    from deploy.console.progress import make_progress
    from deploy.console.wording import some
    from deploy.inventory.folders import refuse_unwritable
    from deploy.simulate.worker_pool import EngineLost, cores

    jobs = cores() if options.jobs is None else options.jobs
    for name, value, least in (("seed", options.seed, 0), ("count", options.count, 1), ("jobs", jobs, 1)):
        if value < least:
            raise InputError(f"--{name} must be at least {least}, got {value}")
    if options.seed + options.count > SEED_MAX:
        raise InputError(f"--seed must be below {SEED_MAX}, got {options.seed}")
    if options.profile not in (None, *PROFILES):
        raise InputError(f"--profile must be one of {', '.join(PROFILES)}, got {show(options.profile)}")
    if options.routed and not options.real:
        raise InputError("--routed belongs to --real: in virtual time there are no links")
    if options.cluster is not None and options.real:
        raise InputError("--cluster is for virtual time: with --real processes are on this machine")
    if options.cluster is not None and options.write:
        raise InputError("--cluster drives scenarios, and with --write none is driven: leave one out")
    refuse_jobs(options)
    wait_s, accept_new = cluster_wait_s(options), accepts_new_keys(options)
    check_cluster(options.cluster)
    seeds = seeds_of(options.profile, options.seed, options.count)
    out = Path(options.out)
    refuse_unwritable(out)  # now, not at the first scenario that fails
    if options.write:
        return _write_all(out, seeds)
    tally = Tally()
    interrupt = Interrupt()
    left = set(seeds)
    lost = ""

    def go_on() -> bool:
        return interrupt.count == 0

    with interrupt.caught():
        progress = make_progress(sys.stderr, len(seeds), quiet=options.quiet, trouble="failed")
        with progress, ExitStack() as stack:
            results: Iterator[Driven]
            if options.real:
                results = real_results(seeds, out, interrupt, routed=options.routed)
            else:
                work = Scenarios(options.shrink)
                made = make_engine(
                    options.cluster, work, jobs, TIMEOUT_S, progress, go_on=go_on, wait_s=wait_s,
                    accept_new=accept_new,
                )  # fmt: skip
                results = stack.enter_context(made).results(seeds, go_on)
            try:
                for driven in results:
                    left.discard(driven.seed)
                    tally.add(driven)
                    if driven.outcome.violations:
                        progress.say(_failure(driven, _kept(out, driven)))
                    progress.add(trouble=bool(driven.outcome.violations))
            except EngineLost as error:
                lost = str(error)
    if not options.quiet:
        for line in lines(tally):
            print(line)
    print(conclusion(tally))
    if lost:
        print(f"{lost}; seeds that were not driven: {some(sorted(left))}", file=sys.stderr)
        return FAILED
    if tally.scenarios < len(seeds):
        return INTERRUPTED
    return FAILED if tally.failed else PASSED


def _write_all(out: Path, seeds: Sequence[int]) -> int:
    """Writes the scenarios as they are drawn."""
    from deploy.chaos.draw import draw
    from deploy.chaos.profiles.pieces import name_of
    from deploy.chaos.run import scenario_text

    for seed in seeds:
        path = out / f"{name_of(seed)}.toml"
        _write(path, scenario_text(draw(seed)))
        print(path)
    return PASSED


def _keep(out: Path, driven: Driven) -> Path:
    """Writes a scenario that failed, the smallest that was found, with what was violated in it."""
    from deploy.chaos.profiles.pieces import name_of
    from deploy.chaos.run import scenario_text

    tables, outcome = driven.small or (driven.tables, driven.outcome)
    path = out / f"{name_of(driven.seed)}.toml"
    what = "Made smaller from" if driven.small else "Drawn from"
    head = [f"{what} seed {driven.seed}: handfast chaos --seed {driven.seed} --count 1"]
    head += [f"Again: handfast simulate {path}", "Violated:"]
    head += [f"  {each.oracle}: {each.message}" for each in outcome.violations]
    _write(path, "".join(f"# {line}\n" for line in head) + "\n" + scenario_text(tables))
    return path


def _kept(out: Path, driven: Driven) -> str:
    """Where a scenario that failed is, or why it is nowhere: its seed draws it again."""
    try:
        return str(_keep(out, driven))
    except InputError as error:
        return str(error)


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None


def _failure(driven: Driven, where: str) -> str:
    first, *more = driven.outcome.violations
    others = f" ({len(more)} more)" if more else ""
    return f"seed {driven.seed}: {first.oracle}: {first.message}{others} -> {where}"
