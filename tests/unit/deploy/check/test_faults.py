"""What `handfast check` says of faults that are each valid."""

from __future__ import annotations

import re

import pytest

from handfast.agent.fleet.loading import load_fleet, parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import HandState
from handfast.deploy.check.check import Finding, check
from handfast.deploy.check.description import describe
from handfast.deploy.console.data_files import FLEETS
from tests.unit.deploy.simulated_run import driven

DELTA = FLEETS / "delta.toml"


def delta(faults: str, *overrides: str) -> Fleet:
    """The bundled delta (edges 1-2, 1-3, 2-3, 2-4, ...; 30 s at 50 Hz) with these faults."""
    text = DELTA.read_text(encoding="utf-8") + faults
    return resolved(parse_fleet(text, overrides=overrides, source="delta.toml"))


def found(faults: str, *overrides: str) -> list[Finding]:
    """But for the room that late messages take (tests/unit/deploy/check/test_braking.py)."""
    sound = check(load_fleet(DELTA))
    findings = [finding for finding in check(delta(faults, *overrides)) if finding not in sound]
    return [finding for finding in findings if "that a robot stands" not in finding.message]


def one(faults: str, *overrides: str) -> Finding:
    findings = found(faults, *overrides)
    assert len(findings) == 1, findings
    return findings[0]


def rule(*lines: str) -> str:
    return "[[faults.rule]]\n" + "\n".join(lines) + "\n"


CUT = rule('name = "cut"', 'partition = "1,2,3 | 4,5,6"', "at = 5", "for = 1.5")


def test_sound_faults_have_nothing_to_report() -> None:
    assert found('[faults]\ndelay = "500ms"\nloss = "30%"\n') == []
    assert found(CUT + rule('link = "1->2"', 'delay = "normal 80ms 20ms"', "at = 8", "for = 3")) == []
    assert found(rule('topic = "wrench"', "robot = 1", 'delay = "40ms"')) == []


# --- when and where ---------------------------------------------------------------------------


def test_a_rule_that_begins_after_the_end() -> None:
    finding = one(rule('name = "x"', 'loss = "10%"', "at = 40"))
    assert (finding.level, finding.place) == ("warning", "faults.rule[1].at")
    assert finding.message == "'x' begins at 40 s, and the run ends at 30 s: it never holds"


def test_a_rule_that_outlives_the_run() -> None:
    finding = one(rule('name = "x"', 'loss = "10%"', "at = 28", "for = 5"))
    assert (finding.level, finding.place) == ("warning", "faults.rule[1].for")
    assert "'x' heals only after the run's end at 30 s (from 28 s for 5 s)" in finding.message
    assert found(rule('name = "x"', 'loss = "10%"', "at = 25", "for = 5")) == []
    repeated = one(rule('loss = "10%"', "at = 0", "for = 1", "every = 2", "until = 40"))
    assert (repeated.level, repeated.place) == ("info", "faults.rule[1].until")


@pytest.mark.parametrize(
    ("where", "field", "says"),
    [
        ('link = "1->4"', "link", "no edge of the formation joins these robots"),
        ('partition = "1 | 4,6"', "partition", "no edge of the formation joins these robots"),
        ('link = "1->2"\ntopic = "state"', "link", "between a robot's agent and its own plant"),
    ],
)
def test_a_rule_for_no_link(where: str, field: str, says: str) -> None:
    finding = one(rule('name = "x"', 'loss = "10%"', where))
    assert (finding.level, finding.place) == ("warning", f"faults.rule[1].{field}")
    assert says in finding.message


# --- contradictions ---------------------------------------------------------------------------

A = ('name = "a"', 'link = "1->2"', 'loss = "30%"')


def test_a_narrower_rule_after_a_wider_one_never_takes_effect() -> None:
    finding = one(rule('name = "b"', "robot = 1", 'loss = "50%"') + rule(*A, "at = 5", "for = 1"))
    assert finding.level == "warning"
    assert "loss of 'a' (30%) never takes effect: 'b' (50%) comes first" in finding.message


@pytest.mark.parametrize(
    "other",
    [
        rule('link = "1->2"', 'delay = "10ms"'),  # another effect
        rule('link = "2->1"', 'loss = "50%"'),  # another link
        rule('link = "1->2"', 'loss = "50%"', "at = 6"),  # another time
        rule('link = "1->2"', 'loss = "30%"', "at = 5.5"),  # the same value
        rule('name = "b"', "robot = 1", 'loss = "50%"'),  # wider
    ],
)
def test_rules_that_take_effect_somewhere_are_as_meant(other: str) -> None:
    assert found(rule(*A, "at = 5", "for = 1") + other) == []


# --- what a fleet does not survive -------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "place", "says"),
    [
        ('[faults]\nloss = "100%"\n', "faults.loss", "robot 2 never hears robot 1, and 17 further links"),
        ('[faults]\nrange = "disc 2m"\n', "faults.range", "they start 2.32 m apart"),
        (rule('link = "3->1"', 'loss = "100%"'), "faults.rule[1].loss", "robot 1 never hears robot 3 (loss"),
        (rule('partition = "alone 1"'), "faults.rule[1].partition", "robot 2 never hears robot 1"),
        (rule("robot = 4", 'topic = "state"', 'loss = "every 1"'), "faults.rule[1].loss", "4's agent never"),
        (rule("robot = 4", 'topic = "wrench"', 'loss = "100%"'), "faults.rule[1].loss", "it will not move"),
        (rule("robot = 4", 'clock_skew = "300ms"'), "faults.rule[1].clock_skew", "4's clock is 0.3 s"),
        (rule("robot = 4", 'clock_skew = "-0.3s"'), "faults.rule[1].clock_skew", "its neighbour 4"),
    ],
)  # fmt: skip
def test_a_fleet_that_cannot_start(faults: str, place: str, says: str) -> None:
    finding = one(faults)
    assert (finding.level, finding.place) == ("error", place)
    assert says in finding.message


def test_what_begins_later_does_not_keep_a_fleet_from_starting() -> None:
    assert {finding.level for finding in found(rule('loss = "100%"', "at = 5"))} == {"info"}
    narrow = rule('link = "*->*"', 'loss = "10%"') + '[faults]\nloss = "100%"\n'
    assert found(narrow) == []  # the rule wins on every link


def test_delays_beyond_the_horizon() -> None:
    finding = one('[faults]\ndelay = "2.5s"\n')
    assert (finding.level, finding.place) == ("warning", "faults.delay")
    assert "hand comes up to 2.5 s late; control.prediction_horizon_s = 2 s" in finding.message
    assert found('[faults]\ndelay = "2.5s"\n', "control.prediction_horizon_s=4") == []
    assert "comes up to 2.3 s late" in one('[faults]\ndelay = "normal 1.5s 200ms"\n').message
    assert found('[faults]\ndelay = "1.5s 200ms"\n') == []  # uniform: at most 1.7 s
    assert one(rule('delay = "0s..3s"', "at = 1", "for = 5")).message.startswith(
        "'rule 1': hand comes up to 3 s late"
    )


def test_clocks_that_drift_apart_are_foreseen() -> None:
    """0.25 s ahead, after 50 s at 0.5 %; the delta drives for 30 s."""
    drift = rule("robot = 2", "clock_skew = '0s 0.005'")
    assert found(drift) == []
    (finding,) = (each for each in found(drift, "fleet.duration_s=75") if "clock" in each.place)
    assert (finding.level, finding.place) == ("warning", "faults.rule[1].clock_skew")
    assert finding.message.startswith("robot 2's clock is 0.375 s ahead of that of its neighbour ")
    behind = rule("robot = 2", 'clock_skew = "-100ms -0.005"')
    (finding,) = (each for each in found(behind, "fleet.duration_s=75") if "clock" in each.place)
    assert "ahead of that of its neighbour 2 after 75 s" in finding.message


def test_a_delay_at_which_neighbours_count_as_silent_for_ever() -> None:
    """`prediction_horizon_s` and 2 s: above 4.0 s no fleet is ready in virtual time, at 4.0 s it is."""
    (finding,) = (each for each in found('[faults]\ndelay = "4.1s"\n') if each.level == "error")
    assert finding.place == "faults.delay"
    assert "robot 2 never hears robot 1 in time, and 17 further links are as late" in finding.message
    for fine in ("4s", "5s 1s", "normal 6s 500ms"):
        assert not [each for each in found(f'[faults]\ndelay = "{fine}"\n') if each.level == "error"]
    longer = found('[faults]\ndelay = "4.1s"\n', "control.prediction_horizon_s=2.2")
    assert not [each for each in longer if each.level == "error"]


def test_delays_between_agent_and_plant() -> None:
    late = one(rule("robot = 4", 'topic = "state"', 'delay = "250ms"'))
    assert "late; control.plant_timeout_s = 0.2 s: an agent that hears nothing newer" in late.message


def test_silences_longer_than_the_horizon_are_told() -> None:
    finding = one(rule('name = "cut"', 'partition = "alone 1"', "at = 5", "for = 4"))
    assert (finding.level, finding.place) == ("info", "faults.rule[1]")
    assert "'cut' lets nothing through on 1->2, 1->3, 2->1, 3->1 for 4 s" in finding.message
    held = one(rule('link = "1->2"', 'loss = "100%"', "at = 5", "for = 4"))
    assert "for 4 s, longer than control.prediction_horizon_s" in held.message
    plant = one(rule("robot = 2", 'topic = "state"', 'loss = "100%"', "at = 5", "for = 1"))
    assert plant.level == "warning"


def test_a_rate_that_cannot_carry_the_messages() -> None:
    finding = one(rule('name = "thin"', 'link = "5->6"', 'rate = "20kbit"'))
    assert (finding.level, finding.place) == ("warning", "faults.rule[1].rate")
    assert "'thin': 20 kbit/s is less than the " in finding.message
    assert found(rule('link = "5->6"', 'rate = "200kbit"')) == []


def test_what_messages_need_is_what_a_fleet_sends() -> None:
    said = re.search(r"less than the ([\d.]+) kbit/s", one(rule('link = "5->6"', 'rate = "20kbit"')).message)
    assert said is not None
    sizes: dict[int, list[int]] = {}
    for _, _, message in driven(delta("", "fleet.duration_s=1")):
        if isinstance(message, HandState) and message.multipliers:
            sizes.setdefault(message.robot, []).append(len(encode(message)))
    most = max(sum(each) / len(each) for each in sizes.values())
    assert float(said[1]) == pytest.approx(8e-3 * 50 * most, rel=0.05)  # with an echo in each: 14 % more


def test_processes_that_do_not_come_back() -> None:
    killed = one(rule('name = "x"', "robot = 3", 'kill = "agent"', "at = 20"))
    assert (killed.level, killed.place) == ("warning", "faults.rule[1].kill")
    assert "robot 3 at 20 s is not started again before the run's end at 30 s" in killed.message
    assert "the others go on without it" in killed.message
    plant = one(rule("robot = 3", 'kill = "plant"', "at = 20"))
    assert "the verdict fails unless another robot takes its place" in plant.message
    both = one(rule("robot = 3", 'kill = "both"', "at = 20"))
    assert "the verdict warns, and the others go on without it" in both.message
    assert found(rule("robot = 3", 'kill = "agent"', "at = 20", "for = 1")) == []
    paused = one(rule("robot = 3", 'pause = "plant"', "at = 29", "for = 2"))
    assert paused.place == "faults.rule[1].pause"
    assert one(rule('tick_jitter = "25ms"')).place == "faults.rule[1].tick_jitter"


def test_a_clock_that_is_a_little_off_is_fine() -> None:
    assert found(rule("robot = 4", 'clock_skew = "200ms"')) == []
    late = one('[faults]\ndelay = "100ms"\n' + rule("robot = 4", 'clock_skew = "300ms"'))
    assert late.level == "warning"  # the delay makes up for it


# --- the description --------------------------------------------------------------------------


def test_the_description_says_what_will_fail() -> None:
    text = describe(delta('[faults]\nloss = "30%"\n' + CUT))
    assert "  faults: loss 30% on every link, all the time\n" in text
    assert "  fault cut: partition 1,2,3 | 4,5,6, from 5 to 6.5 s\n" in text
    assert "fault" not in describe(load_fleet(DELTA))
    many = "".join(rule(f"at = {k}", 'loss = "10%"') for k in range(20))
    assert describe(delta(many)).count("\n  fault rule ") == 12
    assert "  and 8 further faults\n" in describe(delta(many))
