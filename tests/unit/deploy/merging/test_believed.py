"""Orders, fault rules and the fleet file in recordings: which of them count."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Faults, Heartbeat, Mission, Resume, Stop
from handfast.agent.recorder.recorder import About, Received
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import Opener, Sealer
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from handfast.deploy.merging import believed
from handfast.deploy.merging.believed import TEXTS_MAX, FleetFiles, HeldFaults, Order, orders_given
from handfast.deploy.merging.robot_files import MergeError, RobotFile
from tests.trusted import FLEET as GUARDED
from tests.trusted import NOW_S, authority, credentials
from tests.unit.deploy.synthetic_run import make_fleet, triangle

NOW_NS = int(NOW_S * NS_PER_S)
STOP, RESUME = Stop(3, NOW_NS, "lunch"), Resume(4, NOW_NS + 5, ())
MISSION = Mission(1, NOW_NS - 5, NOW_NS, NS_PER_S, "0123456789abcdef")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Opener, Sealer, Sealer]]:
    """Who opens; who seals; and who seals for another authority."""
    folder = tmp_path_factory.mktemp("keys")
    with authority(folder / "authority") as by, authority(folder / "other") as other:
        ann = credentials(by, folder / "ann", of_operator(GUARDED, "ann"))
        eve = credentials(other, folder / "eve", of_operator(GUARDED, "ann"))
        yield Opener(GUARDED, ["ann"], ann.authority), Sealer(ann), Sealer(eve)


def of_most(*of_robots: list[bytes], voters: int | None = None) -> tuple[list[Order], dict[int, int]]:
    recorded = dict(enumerate(of_robots, 1))
    return orders_given(recorded, None, lambda _: len(recorded) if voters is None else voters)


def test_what_most_have_counts_once() -> None:
    both = [encode(MISSION), encode(STOP)]
    assert of_most(both, both, [*both, encode(RESUME)]) == ([MISSION, STOP], {3: 1})
    assert of_most(both, both, []) == ([MISSION, STOP], {})
    assert of_most(both) == ([MISSION, STOP], {})


def test_half_is_not_most() -> None:
    assert of_most([encode(STOP)], []) == ([], {1: 1})
    assert of_most([encode(STOP)], [encode(STOP)], [], []) == ([], {1: 1, 2: 1})
    assert of_most([encode(STOP)], [encode(STOP)], [], [], voters=3)[0] == [STOP]


def test_the_same_order_said_again_is_one_and_nobody_alone_says_when_it_was_given() -> None:
    later, lie = (encode(STOP._replace(time_ns=NOW_NS + by)) for by in (9, -(10**12)))
    assert of_most([encode(STOP), later], [later], [lie])[0] == [STOP]
    assert of_most([lie], [later, encode(STOP)], [encode(STOP)])[0] == [STOP]


def test_what_is_no_order_does_not_count() -> None:
    heartbeat = encode(Heartbeat(NOW_NS, "ann"))
    assert of_most([heartbeat], [heartbeat, b"", b"\xff" * 99]) == ([], {1: 1, 2: 3})


def test_a_seal_counts_though_one_robot_alone_has_it(keys: tuple[Opener, Sealer, Sealer]) -> None:
    opener, ann, _ = keys
    sealed = ann.seal(encode(STOP), NOW_NS)
    assert orders_given({1: [], 2: [sealed], 3: []}, opener, lambda _: 3) == ([STOP], {})


def test_without_a_seal_of_an_operator_nothing_counts(keys: tuple[Opener, Sealer, Sealer]) -> None:
    opener, ann, eve = keys
    forged = [encode(STOP), eve.seal(encode(STOP), NOW_NS), b"", ann.seal(b"x", NOW_NS)]
    forged.append(ann.seal(encode(STOP), NOW_NS).replace(b"lunch", b"hunch"))
    everybody = dict.fromkeys((1, 2, 3), forged)
    assert orders_given(everybody, opener, lambda _: 3) == ([], dict.fromkeys((1, 2, 3), 5))


def test_a_seal_counts_by_the_time_at_which_it_was_made(keys: tuple[Opener, Sealer, Sealer]) -> None:
    """Recordings outlive certificates."""
    opener, ann, _ = keys
    for day, counts in ((0, True), (CERTIFICATE_DAYS - 1, True), (CERTIFICATE_DAYS + 2, False), (-9, False)):
        sealed = ann.seal(encode(STOP), NOW_NS + day * 86_400 * NS_PER_S)
        assert bool(orders_given({1: [sealed]}, opener, lambda _: 1)[0]) == counts, day


def test_sealed_orders_count_without_an_authority_if_most_have_them(
    keys: tuple[Opener, Sealer, Sealer],
) -> None:
    _, ann, _ = keys
    sealed = [ann.seal(encode(STOP), NOW_NS)]
    assert of_most(sealed, sealed, []) == ([STOP], {})
    assert of_most(sealed, [], []) == ([], {1: 1})


def test_so_many_orders_of_one_robot_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(believed, "DISTINCT_MAX", 10)
    flood = [encode(STOP._replace(version=version)) for version in range(100)]
    assert of_most([*flood, encode(MISSION)], [encode(MISSION)], [encode(MISSION)]) == ([MISSION], {1: 100})


# --- fault rules

RULES = '[[faults.rule]]\nloss = "50 %"\n'
SET = Faults(1, 1000, "ann", 900, 0, RULES)


def held(robot: int, message: Faults = SET, role: str = "agent") -> Received:
    return 5, key_expressions.faults_held("f", robot, role), encode(message)


def counted(robots: tuple[int, ...], received: list[Received]) -> HeldFaults:
    found = HeldFaults("f", robots)
    found.count(received)
    return found


def test_rules_that_most_hold_count_whenever_they_say_so() -> None:
    told = [held(1), held(2, SET._replace(time_ns=7)), held(2, SET._replace(author="eve"))]
    found = counted((1, 2, 3), told)
    assert [found.made_up_by(*each[1:]) for each in told] == [None, None, 2]
    assert found.made_up_by(*held(3, SET._replace(time_ns=10))[1:]) is None
    assert found.made_up_by(*held(3, SET._replace(version=2))[1:]) == 3


def test_both_processes_of_one_robot_are_one_robot() -> None:
    found = counted((1, 2, 3), [held(2), held(2, role="plant")])
    assert found.made_up_by(*held(2)[1:]) == 2


def test_other_messages_are_none_of_its() -> None:
    found = counted((1, 2), [(5, key_expressions.faults_held("f", 1, "agent"), b"x")])
    assert found.made_up_by(key_expressions.hand("f", 2), b"x") is None
    assert found.made_up_by(key_expressions.faults_held("f", 2, "agent"), b"x") == 2


def test_so_many_sets_of_one_robot_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(believed, "SETS_MAX", 3)
    flood = [held(2, SET._replace(version=version)) for version in range(10, 20)]
    found = counted((1, 2, 3), [*flood, held(1), held(3)])
    assert found.made_up_by(*held(1)[1:]) is None
    assert [found.made_up_by(*each[1:]) for each in flood] == [2] * 10


# --- fleet files

FLEET = resolved(make_fleet(*triangle(2)))
OTHER = resolved(make_fleet(*triangle(2), duration_s=99.0))
ANOTHER = resolved(make_fleet(*triangle(2), name="another"))
NAME = FLEET.fleet.name


def recorded(robot: int, fleet: Fleet = FLEET, text: str | None = None, **said: str) -> RobotFile:
    toml = tomli_w.dumps(to_dict(fleet)) if text is None else text
    about = About(NAME, digest(fleet), robot, "0.1.0", toml)._replace(**said)
    return RobotFile(Path(f"{robot}"), about, [(0, 10)])


def recorded_by(most_mb: int) -> Fleet:
    return replace(FLEET, recording=replace(FLEET.recording, max_mb=most_mb))


def judged(*among: RobotFile, own: Fleet | None = None) -> tuple[Fleet, list[int], list[str]]:
    fleet, found, said = FleetFiles(own).choose(among, None)
    return fleet, [each.robot for each in found], said


def test_the_missions_file_rules_then_that_of_most() -> None:
    among = [recorded(1), recorded(2, OTHER), recorded(3)]
    assert FleetFiles(None).choose(among, digest(OTHER))[0] == OTHER
    assert FleetFiles(None).choose(among, None)[0] == FLEET
    assert FleetFiles(None).choose(among, "a digest of none")[0] == FLEET


def test_another_file_is_set_aside_for_its_robot() -> None:
    fleet, robots, said = judged(recorded(1), recorded(2, OTHER), recorded(3))
    assert (fleet, robots) == (FLEET, [1, 3])
    assert said == ["what robot 2 recorded is left out: it ran another fleet file in this time"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (tomli_w.dumps(to_dict(OTHER)), "it ran another fleet file in this time"),
        ("[fleet", "the fleet file in it: end of document: not valid TOML"),
        ("", "the fleet file in it: "),
        ("\x1b[2J" + "x" * 10_000, "the fleet file in it: line 1, column 1: not valid TOML"),
        (tomli_w.dumps(to_dict(ANOTHER)), 'the fleet file in it is that of "another"'),
    ],
)  # fmt: skip
def test_a_file_that_is_not_what_its_digest_says_is_set_aside_for_its_robot(text: str, why: str) -> None:
    """It is found out, whichever robot comes first and whatever the operator has."""
    for own in (None, FLEET, OTHER):
        fleet, robots, said = judged(recorded(1, text=text), recorded(2), recorded(3), own=own)
        assert (fleet, robots) == (FLEET, [2, 3])
        assert said[0].startswith(f"what robot 1 recorded is left out: {why}")
        assert len(said[0]) < 400
        assert said[0].isprintable()


def test_where_none_can_be_used_it_says_why() -> None:
    with pytest.raises(MergeError, match="no recording can be used: what robot 1 recorded: the fleet file"):
        judged(recorded(1, text="[fleet"))


def test_what_is_no_part_of_the_digest_is_as_the_operator_has_it() -> None:
    mine, theirs = recorded_by(20), recorded_by(30)
    assert judged(recorded(1, theirs), recorded(2, theirs), own=mine)[0] == mine
    assert judged(recorded(1), recorded(2, theirs), recorded(3))[:2] == (FLEET, [1, 2, 3])


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
    among = [recorded(1), *(recorded(2, recorded_by(20 + k)) for k in range(TEXTS_MAX + 1)), recorded(3)]
    _, robots, said = judged(*among)
    assert robots == [1, *[2] * TEXTS_MAX, 3]
    assert said == [f"what robot 2 recorded is left out: there are more than {TEXTS_MAX} fleet files in it"]
