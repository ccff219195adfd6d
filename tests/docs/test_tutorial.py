"""docs/tutorial.md: its commands are commands, and the quick ones print what it shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

import pytest

from handfast.deploy import cli
from handfast.deploy.console.data_files import FLEETS, SCENARIOS

PAGE = (Path(__file__).parents[2] / "docs" / "tutorial.md").read_text(encoding="utf-8")
BUNDLED = {path.stem for path in FLEETS.glob("*.toml")}
MADE = "mine.toml"
"""The fleet file that the tutorial makes."""
VARIES = re.compile(r"of driving in|\bruns/")
"""What is different in every run."""


class Step(NamedTuple):
    """A command of the page, and what it shows of its output."""

    words: list[str]
    shown: list[str]

    @property
    def command(self) -> str:
        return self.words[0]


def steps() -> list[Step]:
    found = []
    for block in re.findall(r"^```console\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL):
        for part in re.split(r"^\$ ", block.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
            line, *shown = part.splitlines()
            if line.startswith("handfast "):
                found.append(Step(shlex.split(line)[1:], shown))
    return found


STEPS = steps()


def named(step: Step) -> str:
    return " ".join(step.words)


def matches(shown: str, printed: str) -> bool:
    """Where the page has three dots, anything may stand."""
    return re.fullmatch(".*".join(re.escape(part) for part in shown.split("...")), printed) is not None


def missing(step: Step, output: str) -> list[str]:
    """Lines that the page shows and the command has not printed, in this order."""
    printed = iter(output.splitlines())
    lines = [line for line in step.shown if line.strip(" .") and not VARIES.search(line)]
    return [line for line in lines if not any(matches(line, each) for each in printed)]


def drive(step: Step, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    """Exit status, and what is missing in the output."""
    status = cli.main(step.words)
    captured = capsys.readouterr()
    return status, missing(step, captured.err + captured.out)  # first progress, then the verdict


def expected(step: Step) -> int:
    """The exit status that the page shows a command to have."""
    if any("problem" in line for line in step.shown):
        return 2
    return 1 if "FAILED" in step.shown else 0


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with the fleet file that the tutorial makes."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", "mine"]) == 0
    return tmp_path


def test_every_kind_of_command_is_there() -> None:
    shown = {step.command for step in STEPS}
    assert {"run", "check", "simulate", "report", "export", "faults", "new", "sweep", "preflight"} <= shown
    assert {"change", "stop", "resume"} <= shown


@pytest.mark.parametrize("step", STEPS, ids=named)
def test_commands_are_commands(step: Step, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        options = cli._parser().parse_args(step.words)
    except SystemExit:
        pytest.fail(capsys.readouterr().err)
    fleet = getattr(options, "fleet", None)
    assert fleet is None or fleet in BUNDLED | {MADE}
    scenario = getattr(options, "faults", None)
    assert not isinstance(scenario, str) or (SCENARIOS / f"{scenario}.toml").is_file()


def test_new_prints_what_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (step,) = (step for step in STEPS if step.command == "new")
    assert drive(step, capsys) == (0, [])


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("step", [step for step in STEPS if step.command == "check"], ids=named)
def test_check_prints_what_is_shown(step: Step, capsys: pytest.CaptureFixture[str]) -> None:
    assert drive(step, capsys) == (expected(step), [])


SIMULATED = [step for step in STEPS if step.command == "simulate"]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    "step",
    [pytest.param(step, marks=[] if MADE in step.words else [pytest.mark.slow]) for step in SIMULATED],
    ids=named,
)
def test_a_simulation_prints_what_is_shown(step: Step, capsys: pytest.CaptureFixture[str]) -> None:
    quick = Step([*step.words, "--no-report"], step.shown)
    assert drive(quick, capsys) == (expected(step), [])
