"""The command ``handfast``: the table of its commands, and what is the same for all of them."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from errno import EIO, ENOSPC
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from handfast.agent.common.errors import BAD_INPUT, FAILED, INTERRUPTED, PASSED, UNREAD, Error, packages_named
from handfast.deploy.console.data_files import bundled
from handfast.deploy.console.interrupt import remembered

if TYPE_CHECKING:
    pass

ROVER_SIMULATOR: Final = "rover-simulator"
COMPLETION: Final = "completion"
ELSEWHERE: Final = {"list": "status", "film": "export --format gif", "signing": "keys --signing"}
"""Words that people look for among the commands, and the command that does what they say."""
MEANT_MAX: Final = 3
"""So many commands are offered for one that there is not."""
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
GROUPS: Final[Mapping[str, Sequence[Command]]] = {
    "try a fleet on this machine": (
        Command("check", "local.check", "say what the fleet will do and all that is wrong with it"),
        Command("run", "local.run", "drive the fleet with processes on this machine, and report"),
        Command(
            "simulate", "local.simulate", "drive the fleet in virtual time: fast, and the same every time"
        ),
        Command("new", "local.new", "write a commented fleet file to start from"),
    ),
    "study what was driven, or drive it many times": (
        Command(
            "view", "local.view", "show a run, or a fleet as it drives, in the browser, with a STOP beside it"
        ),
        Command("report", "local.report", "rebuild figures, metrics and report of a run from its recording"),
        Command("export", "local.export", "write a run as tables, a ROS 2 bag or a film"),
        Command(
            "sweep",
            "local.sweep",
            "drive the fleet many times over a grid of its fields, in virtual time, on all cores",
        ),
    ),
    "watch, stop and change a running fleet": (
        Command(
            "status", "hosts.status", "list the fleets that run here or are up, or show each process of one"
        ),
        Command("logs", "hosts.logs", "print what the processes of a fleet say, on their hosts or here"),
        Command("stop", "running.stop", "stop every robot, until `handfast resume`"),
        Command(
            "resume",
            "running.resume",
            "let robots drive again after a stop, or after their operators took them over and gave them back",
        ),
        Command(
            "heartbeat",
            "running.heartbeat",
            "hold a fleet's dead-man's switch: it drives while this command runs",
        ),
        Command(
            "change", "running.change", "change a running fleet: a robot joins or leaves, another formation"
        ),
        Command("faults", "running.faults", "let links of a running fleet fail on purpose, and heal them"),
    ),
    "prepare real robots": (
        Command(
            ROVER_SIMULATOR,
            "local.rover_simulator",
            "an ArduPilot Rover to try bridges with, over UDP and TCP",
        ),
        Command(
            "preflight",
            "local.preflight",
            "look at the vehicles of a fleet before a drive: what is well, what is not, what to do",
        ),
    ),
    "drive a fleet on its own computers": (
        Command("keys", "hosts.keys", "make and renew certificates of a secured fleet, give vehicles keys"),
        Command("router", "hosts.router", "run a Zenoh router for a fleet, until Ctrl-C"),
        Command("up", "hosts.up", "bring a fleet up on its hosts"),
        Command("drive", "running.drive", "drive a fleet that is up, and report"),
        Command("fetch", "hosts.fetch", "bring what robots recorded into one run's folder"),
        Command("down", "hosts.down", "end a fleet on its hosts"),
    ),
    "set up your shell": (
        Command(COMPLETION, "local.completion", "print what has the tab key complete commands in your shell"),
    ),
}
"""Every command, by what a person wants; in the order of use."""

COMMANDS: Final = tuple(command for commands in GROUPS.values() for command in commands)

DESCRIPTION: Final = "Drives a group of mobile robots in formation, each on its own."
BEGIN: Final = f"""\
{DESCRIPTION} To begin with:

  handfast check delta    what a fleet will do, and all that is wrong with it
  handfast run delta      drive it with processes on this machine, and report
  handfast new mine       write mine.toml, a commented fleet file of your own

`handfast --help` lists all commands, `handfast COMMAND --help` says what one takes.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status (see `--help`)."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        with remembered(), packages_named():
            if arguments[:1] == [ROVER_SIMULATOR]:
                from handfast.deploy.commands.local.rover_simulator import run

                return run(arguments[1:])
            if not arguments:
                print(BEGIN, end="", flush=True)
                return PASSED
            asked = _asked(arguments)
            try:
                parser = _parser(None if asked == COMPLETION else [asked])
                options = parser.parse_args(arguments)
                options.parser = parser
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
        return UNREAD
    except OSError as error:
        if error.errno not in (ENOSPC, EIO):
            raise
        _write_out()
        if error.errno == EIO:  # its terminal is closed
            return UNREAD
        print(f"handfast: cannot write: {error.strerror}", file=sys.stderr)
        return FAILED
    except Error as error:
        print(f"handfast: {error}", file=sys.stderr)
        return BAD_INPUT


def _asked(arguments: Sequence[str]) -> str:
    """The command that is asked for, "" where there is none.

    Raises:
        Error: there is no such command.
    """
    asked = next((word for word in arguments if not word.startswith("-")), "")
    # What stands before it may be --help or --version, which come first.
    if asked != arguments[0] or asked in (names := [command.name for command in COMMANDS]):
        return asked
    from handfast.agent.common.wording import did_you_mean, show  # here: `--help` does without
    from handfast.deploy.commands.running.change import CHANGES

    written = {name: name for name in names} | {change: f"change {change}" for change in CHANGES} | ELSEWHERE
    known = [asked] if asked in written else written
    question = did_you_mean(asked, known, written.__getitem__, most=MEANT_MAX)
    hint = f"{question} " if question else ""
    raise Error(f"there is no command {show(asked)}: {hint}`handfast --help` lists all")


def process() -> int:
    """`main`, as all that this process does: threads that others left running do not keep it."""
    # OpenBLAS has a thread for each processor, and they spin for each other: where others use one of two,
    # what takes a second alone takes twelve. Nothing here is large enough to gain by it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "agg"  # a notebook's, which its terminals inherit, may not be installed here
    _have_standard_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A terminal that cannot show a name must not fail the command.
            stream.reconfigure(errors="backslashreplace")
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
    parser = _Parser(
        prog="handfast",
        description=DESCRIPTION,
        epilog="FLEET is a fleet file (TOML) or the name of a bundled one: "
        f"{', '.join(bundled())}. Exit status: 0 fine; 1 the verdict failed; 2 bad input; 130 after Ctrl-C; "
        "141 whoever read the output left before its end.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show program's version number and exit")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=_CommandParser
    )
    for command in COMMANDS:
        sub = commands.add_parser(command.name, help=command.help, description=command.help)
        # The simulator reads its arguments by itself: `main` hands them on before they are looked at here.
        if command.name != ROVER_SIMULATOR and (asked is None or command.name in asked):
            import_module(f"handfast.deploy.commands.{command.module}").add_arguments(sub)
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser whose help has the commands in their groups."""

    def format_help(self) -> str:
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        formatter.add_text(self.description)
        listed = {
            title: [argparse.Action([], each.name, metavar=each.name, help=each.help) for each in commands]
            for title, commands in GROUPS.items()
        }
        for title, actions in [*listed.items(), ("options", self._get_optional_actions())]:
            formatter.start_section(title)
            formatter.add_arguments(actions)
            formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()


class _CommandParser(argparse.ArgumentParser):
    """A command's parser. What it does not know it refuses itself, with its usage; argparse would have the
    one above it say so. What an option is given may begin with "-", where a digit follows."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, unknown = super().parse_known_args(args and self._with_negative(args), namespace)
        if unknown:
            from handfast.agent.common.wording import did_you_mean

            names = [name for action in self._actions for name in action.option_strings]
            spelled = next((word.partition("=")[0] for word in unknown if word.startswith("-")), "")
            question = did_you_mean(spelled, names)
            hint = f" ({question})" if question else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return options, unknown

    def _with_negative(self, args: Sequence[str]) -> list[str]:
        """`--duration -5s` as `--duration=-5s`: argparse takes "-5" for a value, but "-5s" for an option."""
        takes = {name for each in self._actions if each.nargs is None for name in each.option_strings}
        joined: list[str] = []
        for word in args:
            if joined and joined[-1] in takes and word[:1] == "-" and word[1:2].isdecimal():
                joined[-1] += f"={word}"
            else:
                joined.append(word)
        return joined


class _Version(argparse.Action):
    """Prints the version and ends; finding it takes a while, so only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from handfast.agent.common.compiled import FORM
        from handfast.agent.runtime.version import handfast_version

        print(f"handfast {handfast_version()} ({FORM})")
        parser.exit()


if __name__ == "__main__":
    sys.exit(process())
