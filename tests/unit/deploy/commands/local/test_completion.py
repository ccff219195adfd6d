"""``handfast completion``: what a shell offers where the tab key is pressed."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from shlex import quote
from typing import Final

import pytest

from handfast.agent.fleet.sections import LAWS
from handfast.deploy.cli import COMMANDS, _parser, main
from handfast.deploy.commands.local.completion import SHELLS, script
from handfast.deploy.console.data_files import FLEETS, SCENARIOS, bundled
from handfast.deploy.report.export import FORMATS

ASK: Final = """
source "$0"
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
$(complete -p handfast | sed 's/.*-F \\([^ ]*\\).*/\\1/')
printf '%s\\n' "${COMPREPLY[@]}"
"""
"""Has bash press the tab key at the end of a line, and prints what it offers."""


@pytest.fixture(scope="module")
def scripts() -> dict[str, str]:
    return {shell: script(_parser(), shell) for shell in SHELLS}


@pytest.fixture
def folder(tmp_path: Path, scripts: dict[str, str]) -> Path:
    """Where somebody works: a fleet file, another file, a run, and bash's script."""
    (tmp_path / "bash").write_text(scripts["bash"])
    work = tmp_path / "work"
    (work / "runs" / "delta-1").mkdir(parents=True)
    (work / "mine.toml").touch()
    (work / "notes.txt").touch()
    return work


def offered(folder: Path, *words: str) -> set[str]:
    """What bash offers for the last of these words."""
    done = subprocess.run(
        ["bash", "--norc", "-c", ASK, str(folder.parent / "bash"), "handfast", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stderr == ""
    return set(done.stdout.split())


def test_bash_takes_the_script(folder: Path) -> None:
    subprocess.run(["bash", "-n", str(folder.parent / "bash")], check=True, timeout=60)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("ru",), {"run"}),
        (("export",), {"export"}),
        (("run", "del"), {"delta"}),
        (("run", "--law", "joint", "del"), {"delta"}),
        (("run", "m"), {"mine.toml"}),
        (("run", "n"), set()),
        (("run", "runs/"), {"runs/delta-1"}),
        (("up", "res"), {"reserve"}),
        (("change", "re"), {"remove", "replace", "reshape"}),
        (("change", "reshape", "delta", "--from", "p"), {"pair"}),
        (("run", "delta", "--faults", "p"), {"partition"}),
        (("run", "delta", "--faults", "m"), {"mine.toml"}),
        (("run", "delta", "--law", "j"), {"joint"}),
        (("run", "delta", "--orders", "n"), {"notes.txt"}),
        (("run", "delta", "--la"), {"--law"}),
        (("view", "r"), {"reserve", "rovers", "rovers_on_hosts", "runs"}),
        (("export", "runs", "--format", "g"), {"gif"}),
        (("view", "n"), set()),
        (("sweep", "runs", "--write", "r"), set()),
        (("faults", "ap"), {"apply"}),
        (("faults", "set", "delta", "--topic", ""), {"hand", "state", "wrench", "all"}),
        (("completion", ""), set(SHELLS)),
    ],
)
def test_bash_offers(words: tuple[str, ...], expected: set[str], folder: Path) -> None:
    assert offered(folder, *words) == expected


def test_bash_offers_all_there_is(folder: Path) -> None:
    assert offered(folder, "") == {command.name for command in COMMANDS}
    assert offered(folder, "check", "") == {*bundled(FLEETS), "mine.toml", "runs"}
    assert offered(folder, "check", "delta", "--faults", "") == {*bundled(SCENARIOS), "mine.toml", "runs"}
    assert offered(folder, "check", "delta", "--law", "") == set(LAWS)
    assert offered(folder, "export", "runs", "--format", "") == set(FORMATS)


def test_zsh_and_fish_are_told_the_same(scripts: dict[str, str]) -> None:
    zsh, fish = scripts["zsh"], scripts["fish"]
    assert zsh.startswith("#compdef handfast\n")
    assert fish.count("complete -c handfast ") > len(COMMANDS)
    for command in COMMANDS:
        assert f"    {command.name}:{quote(command.help)}\n" in zsh
        assert f" -a {command.name} -d {quote(command.help)}\n" in fish
    fleets, scenarios = " ".join(bundled(FLEETS)), " ".join(bundled(SCENARIOS))
    assert f'"names:fleet:({fleets})" "files:file:_files -g \\"*.toml\\""' in zsh
    assert f'"names:scenario:({scenarios})" "files:file:_files -g \\"*.toml\\""' in zsh
    assert f'-ka "{fleets} (_shtab_glob_compgen_' in fish
    assert f'-xka "{scenarios} (_shtab_glob_compgen_' in fish
    assert f":LAW:({' '.join(LAWS)})" in zsh
    assert f'-l law -xka "{" ".join(LAWS)}"' in fish
    assert ":HOST PORT:" in zsh  # a colon would end the name of the value


@pytest.mark.parametrize("shell", SHELLS)
def test_a_shell_that_is_here_takes_its_script(shell: str, scripts: dict[str, str], tmp_path: Path) -> None:
    path = tmp_path / shell
    path.write_text(scripts[shell])
    if program := shutil.which(shell):
        subprocess.run([program, "-n", str(path)], check=True, timeout=60)


def test_the_command_prints_the_script(scripts: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out == scripts["zsh"] + "\n"


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["completion", "tcsh"])
    assert "argument SHELL: invalid choice: 'tcsh'" in capsys.readouterr().err


def test_without_shtab(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 2
    assert capsys.readouterr().err == (
        "handfast: handfast completion needs the package shtab: pip install 'handfast[operator]'\n"
    )


def test_a_parser_without_commands_is_completed_too() -> None:
    assert "_shtab_small" in script(argparse.ArgumentParser(prog="small"), "bash")
