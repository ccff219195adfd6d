"""The docs say what the code does: tables, commands, links, and the orders and fleets that they show."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path

import pytest

from handfast.agent.common.settings import entries
from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.safety import AvoidanceSection, SupervisionSection
from handfast.agent.formation.geometry import resolve, resolved
from handfast.agent.supervision.state_machine import DOES, TRANSITIONS, State
from handfast.deploy import cli
from handfast.deploy.check.check import check
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.verdict.metrics import columns
from handfast.deploy.verdict.oracles import ORACLES
from tests.docs import metrics_page

ROOT = Path(__file__).parents[2]
DOCS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
ORDERS = sorted((ROOT / "docs" / "orders").glob("*.toml"))
ALL = {state.value for state in State}


def text(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def items(name: str, heading: str) -> list[str]:
    """The items of the first list below a heading, each as one line."""
    (part,) = re.findall(rf"^## {heading}\n(.*?)(?=^## |\Z)", text(name), re.MULTILINE | re.DOTALL)
    (found,) = re.findall(r"(?:^- .*\n(?:  .*\n)*)+", part, re.MULTILINE)[:1]
    return [" ".join(item.split()) for item in re.split(r"^- ", found, flags=re.MULTILINE)[1:]]


def words(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


# --- lists ----------------------------------------------------------------------------------------


def test_states() -> None:
    shown = [item.split(": ", 1) for item in items("supervision.md", "States")]
    assert shown == [[f"`{state.value}`", does] for state, does in DOES.items()]


def test_transitions() -> None:
    shown = []
    for item in items("supervision.md", "Transitions"):
        name, sources, target, when = re.findall(r"^`(\w+)`: from (.*), to `(\w+)`: (.+)$", item)[0]
        named = set(words(sources))
        assert when
        shown.append((name, ALL - named if sources.startswith("any") else named, target))
    assert shown == [
        (row.name, {state.value for state in row.sources}, row.target.value) for row in TRANSITIONS
    ]


def test_oracles() -> None:
    shown = [
        re.findall(r"^`(\w+)`: (.*) Not judged: ", item)[0] for item in items("supervision.md", "Oracles")
    ]
    assert shown == [(oracle.name, oracle.says) for oracle in ORACLES]


def test_metrics() -> None:
    assert text("metrics.md") == metrics_page.render(), "make docs"


def test_a_sweeps_columns_are_told() -> None:
    told = text("sweep.md").replace("`.any`", "`min_distance_m.any`")
    assert {name for name in columns() if f"`{name}`" not in told} == set()


def test_parameters_of_avoidance() -> None:
    shown = [words(item)[0] for item in items("avoidance.md", "Parameters")]
    assert sorted(shown) == sorted(entries(AvoidanceSection).keys() - {"enabled"})
    assert (
        set(re.findall(r"`supervision\.(\w+)", text("supervision.md"))) <= entries(SupervisionSection).keys()
    )


# --- what is shown --------------------------------------------------------------------------------


def blocks(path: Path) -> list[str]:
    return re.findall(r"^```toml\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_orders_of_membership_are_sound() -> None:
    (block,) = blocks(ROOT / "docs" / "membership.md")
    parsed = parse_fleet(
        (FLEETS / "reserve.toml").read_text(encoding="utf-8"),
        source="reserve.toml",
        orders=block,
        orders_source="docs/membership.md",
    )
    assert [order.kind for order in parsed.orders] == ["join", "reshape", "stop", "resume"]


@pytest.mark.parametrize("path", ORDERS, ids=lambda path: path.stem)
def test_files_of_orders_are_for_the_reserve(path: Path) -> None:
    fleet = resolved(load_fleet(FLEETS / "reserve.toml", orders=path))
    assert fleet.orders
    assert {finding.level for finding in check(fleet)} <= {"info", "warning"}
    assert f"docs/orders/{path.name}" in path.read_text(encoding="utf-8"), "it says how it is driven"


def test_ten_obstacles_are_ten() -> None:
    fleet = load_fleet(FLEETS / "obstacles.toml")
    assert len(fleet.obstacles) == 10
    assert len(resolve(fleet).ids) == 6


def commands(path: Path) -> list[str]:
    """Every line of code that begins with ``handfast``, continued ones joined."""
    source = path.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line.strip() for line in source.splitlines() if re.match(r" {4,}handfast \w", line)]
    # The rover simulator reads its arguments by itself; what comes after > is the shell's.
    return [line.partition(" > ")[0] for line in lines if "rover-simulator" not in line]


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_commands_are_commands(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = cli._parser()
    for line in commands(path):
        words = shlex.split(line, comments=True)[1:]
        try:
            parser.parse_args(words)
        except SystemExit:
            pytest.fail(f"{path.name}: {line}\n{capsys.readouterr().err}")


def test_every_command_is_shown_somewhere() -> None:
    (subparsers,) = (each for each in cli._parser()._actions if isinstance(each, argparse._SubParsersAction))
    pages = "\n".join(path.read_text(encoding="utf-8") for path in DOCS)
    assert set(subparsers.choices) <= set(re.findall(r"handfast ([\w-]+)", pages))


# --- links ----------------------------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """As the forge makes them of headings."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_links_lead_somewhere(path: Path) -> None:
    prose = re.sub(r"^ {4,}.*$", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        if target.startswith("http"):
            continue
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        assert there.exists(), f"{path.name}: {target}"
        if anchor:
            assert anchor in anchors(there), f"{path.name}: {target}"


def test_every_picture_is_shown() -> None:
    shown = {name for path in DOCS for name in re.findall(r"images/([\w-]+\.png)", path.read_text("utf-8"))}
    assert shown == {path.name for path in (ROOT / "docs" / "images").glob("*.png")}


def test_the_readme_leads_to_every_page() -> None:
    linked = set(re.findall(r"\]\(([\w/-]+\.md)\)", (ROOT / "README.md").read_text(encoding="utf-8")))
    assert {str(path.relative_to(ROOT)) for path in DOCS} - {"README.md"} <= linked


# --- lines and paths ------------------------------------------------------------------------------

LINE_MAX = 110
PACKAGES = "agent|plant|bridges|deploy|tests|docs"
NOT_OURS = {"__init__.py", "__main__.py", "sim_vehicle.py"}
"""Names of files that are in no folder of ours, or in many."""


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_lines_are_short(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    long = [f"{number}: {line}" for number, line in enumerate(lines, 1) if len(line) > LINE_MAX]
    assert not long


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_the_files_and_folders_that_are_named_exist(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    named = set(re.findall(rf"(?<![\w/.-])(?:{PACKAGES})/[\w./-]*\w/?", page))
    assert not sorted(name for name in named if not (ROOT / name).exists())


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_modules_are_named_with_their_folder(path: Path) -> None:
    """A bare `law.py` does not say where to look."""
    prose = re.sub(r"^ {4,}.*$|^```.*?^```$", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    bare = set(re.findall(r"(?<![\w/.>-])[a-z_]+\.py\b", prose))
    assert bare <= NOT_OURS


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_what_is_said_to_be_in_a_file_is_there(path: Path) -> None:
    page = path.read_text(encoding="utf-8")
    for name, file in re.findall(rf"`(\w+)`\s+in\s+`((?:{PACKAGES})/[\w/]+\.py)`", page):
        pattern = rf"^\s*(?:def |class )?{name}\b"
        assert re.search(pattern, (ROOT / file).read_text("utf-8"), re.MULTILINE), f"{name} in {file}"


def test_each_row_of_the_attacks_names_tests_that_there_are() -> None:
    """Codes of the table are explained below it, and what they name exists."""
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    part = page[page.index("## What is guarded against") : page.index("## What is not")]
    codes = {
        code for row in re.findall(r"^\|.*\| ([A-Z0-9 ]+) \|$", part, re.MULTILINE) for code in row.split()
    }
    below = part[part.rindex("|\n") :]
    explained = set(re.findall(r"\b([A-Z]\d)\b", below))
    assert codes == explained
    for entry in re.split(r"\n- |\n\n", below):
        files = [ROOT / name for name in re.findall(r"`(tests/[\w/]+\.py)`", entry)]
        text = "".join(file.read_text(encoding="utf-8") for file in files)
        missing = [name for name in re.findall(r"`(test_\w+)`", entry) if f"def {name}(" not in text]
        assert not missing
