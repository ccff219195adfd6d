"""``python -m tests.benchmarks [NAME ...]``: runs benchmarks and prints their figures beside the targets.

Figures are never asserted: the exit status is 0 unless a benchmark could not run. What this machine cannot do
(no compiled form, for example) is left out, and said.
"""

from __future__ import annotations

import argparse
import json
import platform
import signal
import sys
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.figures import Figure, Options, Result, figure_table, load
from tests.benchmarks.processes import BenchmarkError, NotHereError

NAMES: Final = (
    "cpu",
    "tick",
    "forms",
    "startup",
    "reactions",
    "virtual_time",
    "links",
    "robustness",
    "random_starts",
    "crowd",
    "swaps",
    "recording",
)
LOAD_QUIET: Final = 0.5


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all without any")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter rounds")
    parser.add_argument("--count", type=int, metavar="N", help="random starts (default: as each has it)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    return parser


def _run(name: str, options: Options) -> tuple[Result | None, dict[str, Any]]:
    print(f"\n=== {name}: {load()}", flush=True)
    begun = time.monotonic()
    run: Callable[[Options], Result] = import_module(f"tests.benchmarks.{name}").run
    try:
        result = run(options)
    except NotHereError:
        raise
    except BenchmarkError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return None, {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        return None, {"error": f"{type(error).__name__}: {error}"}
    took_s = time.monotonic() - begun
    print("\n".join(figure_table(result.figures)))
    if result.details:
        print("\n" + "\n".join(result.details))
    print(f"({took_s:.0f} s; {load()})", flush=True)
    return result, result.as_dict() | {"took_s": round(took_s, 1), "load_after": load()}


def _summary(results: dict[str, Result]) -> list[Figure]:
    return [figure for result in results.values() for figure in result.figures if figure.met is not None]


def main() -> int:
    options = _parser().parse_args()
    unknown = sorted(set(options.names) - set(NAMES))
    if unknown:
        print(f"no benchmark is called {', '.join(unknown)}; there are: {', '.join(NAMES)}", file=sys.stderr)
        return 2
    # Whatever ends this process, its processes end in order (a shell's `&` leaves SIGINT ignored).
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.default_int_handler)
    # Some builds of Python take half as much again as others.
    python = f"Python {platform.python_version()} of {sys.base_prefix}"
    print(f"{time.strftime('%Y-%m-%d %H:%M:%S')}, {python}, {load()}")
    results: dict[str, Result] = {}
    record: dict[str, Any] = {
        "begun": time.strftime("%Y-%m-%dT%H:%M:%S"),
        "python": python,
        "quick": options.quick,
    }
    failed = False
    try:
        for name in options.names or NAMES:
            try:
                result, record[name] = _run(name, Options(options.quick, options.count))
            except NotHereError as error:
                print(f"{name}: not run: {error}", file=sys.stderr)
                record[name] = {"not_run": str(error)}
                failed |= bool(options.names)
                continue
            if result is None:
                failed = True
            else:
                results[name] = result
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    finally:
        if options.json is not None:
            options.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    targets = _summary(results)
    if targets:
        met = sum(figure.met is True for figure in targets)
        print(f"\n=== summary: {met} of {len(targets)} targets met")
        print("\n".join(figure_table(targets)))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
