"""``python -m bridges.mavlink.bridge.parameter_program --fleet FILE``: reads and sets parameters of vehicles,
on the computer that they are joined to, in place of their bridges.

Takes tasks as JSON on standard input (`bridges.mavlink.bridge.parameter_setup.tasks_to_json`) and prints the
answers, as one line of JSON by robot.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from agent.common.exit import BAD_INPUT, PASSED
from agent.fleet.loading import load_fleet
from agent.fleet.model import FleetError
from agent.runtime.clock import RealClock
from bridges.mavlink.bridge.parameter_setup import carry_out, tasks_of


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the program; returns its exit status."""
    parser = argparse.ArgumentParser(prog="parameter_program", allow_abbrev=False)
    parser.add_argument("--fleet", required=True, metavar="FILE")
    options = parser.parse_args(argv)
    try:
        fleet = load_fleet(options.fleet)
        tasks = tasks_of(json.load(sys.stdin))
    except FleetError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        print(f"no tasks: {error}", file=sys.stderr)
        return BAD_INPUT
    answers = carry_out(fleet, tasks, RealClock(), lambda: False)
    print(json.dumps({robot: answer._asdict() for robot, answer in answers.items()}))
    return PASSED


if __name__ == "__main__":
    sys.exit(main())
