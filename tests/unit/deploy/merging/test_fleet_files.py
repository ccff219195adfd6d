"""Which fleet file rules a run of recordings, and whose recording has another one, or none of use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.loading import digest, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.recorder.segments import About
from handfast.deploy.merging.fleet_files import TEXTS_MAX, FleetFiles, Ruling, taken
from handfast.deploy.merging.robot_recording import MergeError, SegmentFile
from tests.unit.deploy.synthetic_run import make_fleet, triangle

FLEET = resolved(make_fleet(*triangle(2)))
OTHER = resolved(make_fleet(*triangle(2), duration_s=99.0))
ANOTHER = resolved(make_fleet(*triangle(2), name="another"))
NAME = FLEET.fleet.name


def recorded(robot: int, fleet: Fleet = FLEET, text: str | None = None, **said: str) -> SegmentFile:
    toml = tomli_w.dumps(to_dict(fleet)) if text is None else text
    about = About(NAME, digest(fleet), robot, "0.1.0", "boot", 1, 0, toml)._replace(**said)
    return SegmentFile(Path(f"{robot}"), about, 1, [(0, 10)])


def described(text: str) -> Fleet:
    return replace(FLEET, fleet=replace(FLEET.fleet, description=text))


def judged(*among: SegmentFile, own: Fleet | None = None) -> tuple[Ruling, list[int], list[str]]:
    files = FleetFiles(own)
    ruling = files.choose(among, None)
    found, said = taken(files, among, ruling)
    return ruling, [each.about.robot for each in found], said


def test_the_missions_file_rules_then_the_operators_own_then_that_of_most() -> None:
    among = [recorded(1), recorded(2, OTHER), recorded(3)]
    assert FleetFiles(OTHER).choose(among, digest(FLEET)) == Ruling(FLEET, digest(FLEET))
    assert FleetFiles(OTHER).choose(among, None) == Ruling(OTHER, digest(OTHER))
    assert FleetFiles(None).choose(among, None) == Ruling(FLEET, digest(FLEET))
    assert FleetFiles(None).choose(among, "a digest of none") == Ruling(FLEET, digest(FLEET))


def test_another_file_is_set_aside_for_its_robot() -> None:
    ruling, robots, said = judged(recorded(1), recorded(2, OTHER), recorded(3))
    assert (ruling.fleet, robots) == (FLEET, [1, 3])
    assert said == ["what robot 2 recorded is left out: it ran another fleet file in this time"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (tomli_w.dumps(to_dict(OTHER)), "the fleet file in it is not the one that its digest names"),
        ("[fleet", "the fleet file in it: end of document: not valid TOML"),
        ("", "the fleet file in it: "),
        ("\x1b[2J" + "x" * 10_000, "the fleet file in it: line 1, column 1: not valid TOML"),
        (tomli_w.dumps(to_dict(ANOTHER)), 'the fleet file in it is that of "another"'),
    ],
)  # fmt: skip
def test_a_file_that_is_not_what_its_digest_names_is_set_aside_for_its_robot(text: str, why: str) -> None:
    """It is found out, whichever robot comes first and whatever the operator has."""
    for own in (None, FLEET, OTHER):
        ruling, robots, said = judged(recorded(1, text=text), recorded(2), recorded(3), own=own)
        assert (ruling.fleet, robots) == (FLEET, [2, 3])
        assert said[0].startswith(f"what robot 1 recorded is left out: {why}")
        assert len(said[0]) < 400
        assert said[0].isprintable()


def test_where_none_can_be_used_it_says_why() -> None:
    with pytest.raises(MergeError, match="no recording can be used: what robot 1 recorded: the fleet file"):
        judged(recorded(1, text=tomli_w.dumps(to_dict(OTHER))))


def test_what_is_no_robots_affair_is_as_the_operator_or_most_have_it() -> None:
    """A description has no part in the digest."""
    mine, theirs = described("mine"), described("made up")
    assert judged(recorded(1, theirs), recorded(2, theirs), own=mine)[0].fleet == mine
    assert judged(recorded(1, theirs), recorded(2), recorded(3))[:2] == ((FLEET, digest(FLEET)), [1, 2, 3])


def test_what_another_version_made_counts_if_most_have_it() -> None:
    """It may have computed the digest of more, or of less."""
    old = "fedcba9876543210"
    among = [recorded(robot, digest=old) for robot in (1, 2, 3)]
    ruling, robots, said = judged(*among)
    assert (ruling, robots, said) == (Ruling(FLEET, old), [1, 2, 3], [])
    with pytest.raises(MergeError):
        judged(recorded(1, digest=old), recorded(2, OTHER, digest=old))
    _, robots, said = judged(*among[:2], recorded(3, OTHER, digest=old))
    assert robots == [1, 2]
    assert said == [
        "what robot 3 recorded is left out: the fleet file in it is not the one that its digest names"
    ]


def test_a_recording_has_no_code_loaded_that_the_operators_own_file_does_not_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_of_a_recording.py").write_text(f"open({str(tmp_path / 'done')!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(tmp_path)
    law = to_dict(FLEET)
    law["control"]["law"] = "evil_of_a_recording:Law"
    plant = to_dict(FLEET)
    plant["robot"][1]["plant"] = "evil_of_a_recording:Plant"
    for evil in (law, plant):
        among = [recorded(1), recorded(2, text=tomli_w.dumps(evil)), recorded(3)]
        _, robots, (said,) = judged(*among)
        assert robots == [1, 3]
        assert "names the plugin" in said
        assert "which yours does not: it is not loaded" in said
        with pytest.raises(MergeError, match="names the plugin"):
            judged(among[1])
    assert not (tmp_path / "done").exists()


def test_so_many_files_of_one_robot_are_read() -> None:
    among = [recorded(1), *(recorded(2, described(f"no. {k}")) for k in range(TEXTS_MAX + 1)), recorded(3)]
    _, robots, said = judged(*among)
    assert robots == [1, *[2] * TEXTS_MAX, 3]
    assert said == [f"what robot 2 recorded is left out: there are more than {TEXTS_MAX} fleet files in it"]
