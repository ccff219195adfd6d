"""The command ``handfast completion``: what has the tab key complete commands, in bash, zsh and fish.

The script is made by shtab from the parser of the whole command line; what it cannot know is said here: which
values an argument may have, by the name that its help has for them (FLEET, RUN, ...).
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from handfast.agent.common.errors import PASSED, packages_named
from handfast.agent.fleet.sections import LAWS
from handfast.deploy.console.arguments import describe
from handfast.deploy.console.data_files import FLEETS, SCENARIOS, bundled

SHELLS: Final = ("bash", "zsh", "fish")
_OPTIONS: Final = re.compile(r"\w+(\|\w+)+")
"""The name of a value that is one of a few: ``hand|state|wrench|all``."""

Complete = Mapping[str, str | Mapping[str, str]]
"""What completes one argument, as shtab has it: by shell, and under "preamble" what that needs, by shell."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast completion`` takes."""
    describe(
        parser,
        ": commands, their options, bundled fleets and scenarios, fleet files, laws, folders of runs. Once, "
        "and again after an upgrade, into the file that the shell reads; then begin a new shell. "
        "bash, with the package bash-completion: "
        "`handfast completion bash > ~/.local/share/bash-completion/completions/handfast`. "
        "zsh: `handfast completion zsh > ~/.zfunc/_handfast`, with `fpath+=~/.zfunc` before `compinit` in "
        "~/.zshrc. fish: `handfast completion fish > ~/.config/fish/completions/handfast.fish`. The folders "
        "have to be there.",
    )
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    parser.set_defaults(command=_completion)


@packages_named("handfast completion")
def _completion(options: argparse.Namespace) -> int:
    print(script(options.parser, options.shell))
    return PASSED


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """The script for one of `SHELLS`; the parser is not to be used for anything else after it.

    Raises:
        ModuleNotFoundError: shtab is not installed.
    """
    import shtab

    from handfast.deploy.report.export import FORMATS

    values: dict[str, Complete] = {
        "FLEET": _one_of("fleet", bundled(FLEETS)),
        "SCENARIO": _one_of("scenario", bundled(SCENARIOS)),
        "RUN": shtab.DIRECTORY,
        "RUN|FLEET": _one_of("fleet", bundled(FLEETS)),
        "DIR": shtab.DIRECTORY,
        "FILE": shtab.FILE,
        "PATH": shtab.FILE,
    }
    options = {"LAW": tuple(LAWS), "FORMAT": FORMATS}
    for each in _parsers(parser):
        each.description = None  # in a list of commands their one line of help says more
        for action in each._actions:
            name = action.metavar if isinstance(action.metavar, str) else ""
            if name in values and not (name == "RUN" and action.option_strings):  # there it is a number
                setattr(action, "complete", values[name])  # noqa: B010  where shtab looks for it
            elif name in options:
                action.choices = options[name]
            elif _OPTIONS.fullmatch(name):
                action.choices = name.split("|")
            if name:
                action.metavar = name.replace(":", " ")  # which ends a name, in zsh
    return shtab.complete(parser, shell)


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parser of every command, and of every command of these."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield each
                yield from _parsers(each)


def _one_of(what: str, names: Iterable[str]) -> Complete:
    """Completes the name of something bundled, or a file of TOML."""
    import shtab

    words = " ".join(names)
    toml: Mapping[str, Any] = shtab.glob("*.toml")
    # By "files" in its name shtab knows a function that gives files.
    function = f"_handfast_files_of_{what}"
    bash = f'{function}() {{\n  compgen -W "{words}" -- "$1"\n  {toml["bash"]} "$1"\n}}'
    # Not shtab's own pattern: zsh takes one in brackets, without a |, for qualifiers of files.
    zsh = f'{function}() {{\n  _alternative "names:{what}:({words})" "files:file:_files -g \\"*.toml\\""\n}}'
    given: Mapping[str, str] = toml["preamble"]
    return {
        "bash": function,
        "zsh": function,
        "fish": f"{words} {toml['fish']}",
        "preamble": {"bash": f"{given['bash']}\n{bash}", "zsh": zsh, "fish": given["fish"]},
    }
