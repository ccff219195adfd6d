"""The command ``handfast``: the table of its commands, and what is the same for all of them."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from errno import ENOSPC
from importlib import import_module
from importlib.machinery import PathFinder
from os.path import dirname
from typing import TYPE_CHECKING, Any, Final, NamedTuple

for _name in ("agent", "plant", "bridges"):  # before anything of them runs; as in handfast.py
    _ours, _found = PathFinder.find_spec(_name, [dirname(dirname(__file__))]), PathFinder.find_spec(_name)
    if _ours and _found and _found.origin and _ours.origin != _found.origin:
        _wrong = f"{_found.origin} takes the place of handfast's package {_name}: rename it"
        print(f"handfast: {_wrong}", file=sys.stderr)
        sys.exit(2)  # agent.common.exit.BAD_INPUT

from agent.common.errors import Error, packages_named
from agent.common.exit import BAD_INPUT, FAILED, INTERRUPTED, PASSED
from deploy.console.data_files import bundled
from deploy.console.interrupt import remembered

if TYPE_CHECKING:
    from deploy.processes.forking import ForkServer

ROVER_SIMULATOR: Final = "rover-simulator"
FORKS: Final = "run"
THREADS_S: Final = 1.0
"""So long a thread of others may go on after the command."""


class Command(NamedTuple):
    """One command.

    Attributes:
        module: of `deploy.commands`. Its `add_arguments(parser)` says what the command takes, and sets
            `command` to what it does: from the options to the exit status.
        help: one line.
    """

    name: str
    module: str
    help: str


# Imported is only the module of the command that is asked for: `--help` and a stop have to be quick.
COMMANDS: Final = (
    Command("run", "local.run", "drive the fleet with processes on this machine, and report"),
    Command("simulate", "local.simulate", "drive the fleet in virtual time: fast, and the same every time"),
    Command("check", "local.check", "say what the fleet will do and all that is wrong with it"),
    Command(
        "preflight",
        "local.preflight",
        "look at the vehicles of a fleet before a drive: what is well, what is not, what to do",
    ),
    Command("keys", "hosts.keys", "make and renew the certificates that a secured fleet trusts"),
    Command("router", "hosts.router", "run a Zenoh router for a fleet, until Ctrl-C"),
    Command("up", "hosts.up", "bring a fleet up on its hosts"),
    Command("list", "running.list_fleets", "say which fleets run here or are up, and how to stop each"),
    Command("status", "hosts.status", "say what each process of a fleet does, on its host or here"),
    Command("logs", "hosts.logs", "print what the processes of a fleet say, on their hosts or here"),
    Command("fetch", "hosts.fetch", "bring what robots recorded into one run's folder"),
    Command("down", "hosts.down", "end a fleet on its hosts"),
    Command(
        "export-deployment",
        "hosts.export_deployment",
        "write a fleet as a folder for Ansible, to bring up hundreds of robots",
    ),
    Command("firewall", "hosts.firewall", "print a firewall for hosts, against strangers that flood ports"),
    Command("drive", "running.drive", "drive a fleet that is up, and report"),
    Command("stop", "running.stop", "stop every robot, until `handfast resume`"),
    Command(
        "resume",
        "running.resume",
        "let robots drive again after a stop, or after their operators took them over and gave them back",
    ),
    Command("join", "running.join", "give a robot in reserve a place in a running fleet's formation"),
    Command("leave", "running.leave", "take a robot out of a running fleet's formation"),
    Command("replace", "running.replace", "give a robot's place and edges to one in reserve"),
    Command("remove", "running.remove", "say that the body of a silent robot has been carried off the field"),
    Command("reshape", "running.reshape", "give a running fleet another formation or trajectory"),
    Command(
        "heartbeat",
        "running.heartbeat",
        "hold a fleet's dead-man's switch: it drives while this command runs",
    ),
    Command("faults", "running.faults", "let links of a running fleet fail on purpose, and heal them"),
    Command("signing", "hosts.signing", "give vehicles the keys with which they and their bridges sign"),
    Command(
        "sweep",
        "local.sweep",
        "drive the fleet many times over a grid of its fields, in virtual time, on all cores",
    ),
    Command(
        "chaos",
        "local.chaos",
        "drive random scenarios with faults, orders and obstacles, and judge each by every oracle",
    ),
    Command(
        ROVER_SIMULATOR, "local.rover_simulator", "an ArduPilot Rover to try bridges with, over UDP and TCP"
    ),
    Command("view", "local.view", "show a recorded run in the browser, at any moment of it"),
    Command("film", "local.film", "make a film of a run, for a slide or a README"),
    Command("report", "local.report", "rebuild figures, metrics and report of a run from its recording"),
    Command("export", "local.export", "write a run's data as tables"),
    Command("new", "local.new", "write a commented fleet file to start from"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status (see `--help`)."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        with remembered(), packages_named():
            if arguments[:1] == [ROVER_SIMULATOR]:
                from deploy.commands.local.rover_simulator import run

                return run(arguments[1:])
            asked = next((word for word in arguments if not word.startswith("-")), "")
            try:
                with _fork_server(asked, arguments) as server:
                    options = _parser([asked]).parse_args(arguments)
                    options.server = server
                    result: int = options.command(options)
            except SystemExit:
                print(end="", flush=True)
                raise
            print(end="", flush=True)  # here, where an output that nobody takes is found
            return result
    except KeyboardInterrupt:
        # One that came up through an `exec`, as of a dataclass that was being made, has `python -m` end
        # with the signal instead of with a status, unless another `exec` comes after it.
        exec("")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output is gone (`handfast check ... | head`): nothing is left to say or flush.
        _write_out()
        return FAILED
    except OSError as error:
        if error.errno != ENOSPC:
            raise
        _write_out()
        print(f"handfast: cannot write: {error.strerror}", file=sys.stderr)
        return FAILED
    except Error as error:
        print(f"handfast: {error}", file=sys.stderr)
        return BAD_INPUT


def _fork_server(asked: str, arguments: Collection[str]) -> AbstractContextManager[ForkServer | None]:
    """What forks robots' processes, for the command that needs it: it loads what they need while the command
    loads what that needs."""
    if asked != FORKS or not {"-h", "--help"}.isdisjoint(arguments):
        return nullcontext()
    from deploy.processes.child import environment
    from deploy.processes.forking import ForkServer

    return ForkServer(environment())


def process() -> int:
    """`main`, as all that this process does: threads that others left running do not keep it."""
    # OpenBLAS has a thread for each processor, and they spin for each other: where others use one of two,
    # what takes a second alone takes twelve. Nothing here is large enough to gain by it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _have_standard_streams()
    try:
        status = main()
    except SystemExit as ended:  # of the parser
        status = ended.code if isinstance(ended.code, int) else PASSED
    except KeyboardInterrupt:  # a second one, while the first was answered
        exec("")  # as above
        status = INTERRUPTED
    if threading.active_count() == 1:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends: what is said already is its status
        return status
    try:
        until = time.monotonic() + THREADS_S
        main_thread = threading.main_thread()
        others = [each for each in threading.enumerate() if not each.daemon and each is not main_thread]
        for each in others:
            each.join(max(0.0, until - time.monotonic()))
        names = ", ".join(each.name for each in others if each.is_alive())
        if not names:
            return status
        print(f"handfast: ends threads that a plugin left running: {names}", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        status = INTERRUPTED
    _write_out()
    os._exit(status)  # at its end the interpreter would wait for them


def _have_standard_streams() -> None:
    """Has what is said to a stream that is closed (`handfast run delta 2>&-`) go nowhere: else the next file
    that is opened gets its number, and `print` takes the other stream."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # it gets the lowest number that is free
            setattr(sys, name, os.fdopen(nowhere, "w" if number else "r"))


def _write_out() -> None:
    """Writes what was printed; what cannot be written is not tried again at the process's end."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parser(asked: Collection[str] | None = None) -> argparse.ArgumentParser:
    """The parser of the command line, with the arguments of the commands that are `asked` for, or of all."""
    parser = argparse.ArgumentParser(
        prog="handfast",
        description="Drives a group of mobile robots in formation, each on its own.",
        epilog="FLEET is a fleet file (TOML) or the name of a bundled one: "
        f"{', '.join(bundled())}. Exit status: 0 fine; 1 the verdict failed; 2 bad input; 130 after Ctrl-C.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        sub = commands.add_parser(command.name, help=command.help, description=command.help)
        # The simulator reads its arguments by itself: `main` hands them on before they are looked at here.
        if command.name != ROVER_SIMULATOR and (asked is None or command.name in asked):
            import_module(f"deploy.commands.{command.module}").add_arguments(sub)
    return parser


class _Version(argparse.Action):
    """Prints the version and ends; finding it takes a while, so only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from agent.common.compiled import FORM
        from agent.runtime.version import handfast_version

        print(f"handfast {handfast_version()} ({FORM})")
        parser.exit()


if __name__ == "__main__":
    sys.exit(process())
