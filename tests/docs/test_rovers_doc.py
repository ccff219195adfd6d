"""docs/rovers.md: its fleet file drives; docs/rovers-measurements.md: the tests that it names are there."""

from __future__ import annotations

import re
from pathlib import Path

from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.bridges.mavlink.session.requests import AUDITED
from handfast.deploy.check.check import check
from handfast.deploy.console.data_files import FLEETS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "rovers.md").read_text(encoding="utf-8")
ON_HOSTS = (ROOT / "docs" / "rovers-on-hosts.md").read_text(encoding="utf-8")
TOML = re.compile(r"^```toml\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCKS = TOML.findall(TEXT)
MEASURED = (ROOT / "docs" / "rovers-measurements.md").read_text(encoding="utf-8")


def fleet(*overrides: str) -> Fleet:
    return parse_fleet(BLOCKS[0], source="docs/rovers.md", overrides=overrides)


def test_its_fleet_file_is_sound_but_for_signing() -> None:
    found = check(fleet())
    unsound = [finding.place for finding in found if finding.level != "info"]
    assert unsound == ["robot[1].mavlink.signing_key"]
    assert [robot.plant for robot in fleet().robots] == ["mavlink", "mavlink"]


def test_the_fleet_on_hosts_is_the_bundled_one_word_for_word() -> None:
    (block,) = TOML.findall(ON_HOSTS)
    assert block == (FLEETS / "rovers_on_hosts.toml").read_text(encoding="utf-8")
    found = check(resolved(parse_fleet(block, source="docs/rovers.md")))
    assert {finding.level for finding in found} <= {"info", "warning"}
    assert [finding.place for finding in found if finding.level == "warning"] == ["datum"]


def test_one_rover_can_be_tried_with_a_simulated_partner() -> None:
    alone = fleet("robot.2.plant=unicycle")
    assert [robot.plant for robot in alone.robots] == ["mavlink", "unicycle"]
    assert {finding.level for finding in check(alone)} <= {"info", "warning"}


def test_the_tests_that_it_names_exist() -> None:
    named = set(re.findall(r"`(test_\w+)`", MEASURED))
    assert len(named) > 15
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    missing = sorted(name for name in named if f"def {name}(" not in tests)
    assert not missing


def test_the_parameters_in_bold_are_those_that_are_read() -> None:
    part = TEXT.split("## Parameters")[1].split("## ")[0]
    rows = re.findall(r"^- ((?:\*\*|`).*?): ", part, re.MULTILINE)
    bold = {name for row in rows for name in re.findall(r"\*\*`(\w+)`\*\*", row)}
    assert bold
    assert bold <= set(AUDITED)
    other = {name for row in rows for name in re.findall(r"(?<!\*)`([A-Z]\w+)`(?!\*)", row)}
    # Those in brackets are newer names of what is in bold.
    assert {name for name in other if name in AUDITED} <= {"MAV_SYSID", "MAV_GCS_SYSID", "ARMING_SKIPCHK"}
