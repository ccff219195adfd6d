"""Faults in the fleet file: what is read, what is refused and in which words."""

from __future__ import annotations

import pytest
import tomli_w

from handfast.agent.fleet.fault_rules import ClockError, LinkSet, Partition
from handfast.agent.fleet.loading import ScenarioError, digest, parse_fleet, parse_scenario, to_dict
from handfast.agent.fleet.model import FleetError

FLEET = """
robot = [
  { id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1.5, y_m = 0 },
  { id = 3, x_m = 3, y_m = 0 }, { id = 4, x_m = 4.5, y_m = 0 },
]
fleet = { name = "four" }
[formation]
edges = [[1, 2], [2, 3], [3, 4]]
offsets = [[0, 0], [1, 0], [2, 0], [3, 0]]
safe_distance_m = 0.2
"""
IDS = (1, 2, 3, 4)


def problems(faults: str, *overrides: str) -> list[str]:
    with pytest.raises(FleetError) as caught:
        parse_fleet(FLEET + faults, source="here", overrides=overrides)
    return [str(problem) for problem in caught.value.problems]


# --- what is read -----------------------------------------------------------------------------


def test_a_file_without_faults_has_none() -> None:
    section = parse_fleet(FLEET, source="here").faults
    assert section.rules == ()
    assert section.delay is None
    assert section.seed is None


def test_the_command_line_sets_defaults_of_all_links() -> None:
    overrides = ("faults.delay=200ms", "faults.loss=30%", "faults.seed=7")
    section = parse_fleet(FLEET, source="here", overrides=overrides).faults
    assert str(section.delay) == "200ms"
    assert str(section.loss) == "30%"
    assert section.seed == 7


@pytest.mark.parametrize(
    ("written", "meant"), [("0", "0s"), ("0.2", "200ms"), ("normal 80ms 20ms 25%", None)]
)
def test_a_delay_may_be_a_number_or_a_text(written: str, meant: str | None) -> None:
    section = parse_fleet(FLEET, source="here", overrides=[f"faults.delay={written}"]).faults
    assert str(section.delay) == (meant or written)


def test_every_field_of_a_rule_survives_writing_and_reading() -> None:
    text = (
        FLEET
        + """
[faults]
delay = "normal 80ms 20ms"
[[faults.rule]]
name = "flap"
link = ["1->2", "3<->4"]
at = "5s"
for = "500ms"
every = "1s"
until = "20s"
loss = "gemodel 1% 10%"
[[faults.rule]]
partition = "1,2 | 3,4"
at = 5
for = 5
[[faults.rule]]
robot = [1, 3]
topic = "state"
delay = "80ms"
[[faults.rule]]
robot = 2
position_bias_m = [0.1, -0.2]
jump_m = 0.5
[[faults.rule]]
robot = 3
clock_skew = "100ms 50ppm"
[[faults.rule]]
robot = 4
kill = "agent"
at = "5s"
for = "2s"
[[faults.rule]]
link = "*->3"
at = 0
for = "10s"
loss = "0%..50%"
"""
    )
    fleet = parse_fleet(text, source="here")
    again = parse_fleet(tomli_w.dumps(to_dict(fleet)), source="there")
    assert again == fleet
    assert digest(again) == digest(fleet)
    assert str(fleet.faults.rules[0].link) == "1->2; 3->4; 4->3"
    assert fleet.faults.rules[4].clock_skew == ClockError(0.1, 50e-6)


def test_faults_are_part_of_what_robots_agree_on() -> None:
    plain = parse_fleet(FLEET, source="here")
    assert digest(plain) != digest(parse_fleet(FLEET, source="here", overrides=["faults.loss=1%"]))


def test_a_rule_is_addressed_by_its_name() -> None:
    text = FLEET + '[[faults.rule]]\nname = "cut"\nlink = "1->2"\nloss = "10%"\n'
    fleet = parse_fleet(text, source="here", overrides=["faults.rule.cut.loss=20%"])
    assert str(fleet.faults.rules[0].loss) == "20%"
    with pytest.raises(FleetError, match=r"there is no faults\.rule with id gap; ids are \"cut\""):
        parse_fleet(text, source="here", overrides=["faults.rule.gap.loss=20%"])


# --- links and partitions ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "has", "has_not"),
    [
        ("1->2", [(1, 2)], [(2, 1), (1, 3)]),
        ("1<->2", [(1, 2), (2, 1)], [(1, 3)]),
        ("1,2->3", [(1, 3), (2, 3)], [(3, 1), (1, 2)]),
        ("*->3", [(1, 3), (4, 3)], [(3, 1)]),
        ("*", [], []),
        ("1->2; 3->4", [(1, 2), (3, 4)], [(2, 3)]),
    ],
)
def test_links(text: str, has: list[tuple[int, int]], has_not: list[tuple[int, int]]) -> None:
    if text == "*":
        with pytest.raises(ValueError, match="must be a link such as"):
            LinkSet.parse(text)
        return
    links = LinkSet.parse(text)
    assert all(links.has(*pair) for pair in has)
    assert not any(links.has(*pair) for pair in has_not)
    assert LinkSet.parse(str(links)) == links


def cut(text: str, ids: tuple[int, ...] = (1, 2, 3, 4, 5, 6)) -> set[tuple[int, int]]:
    partition = Partition.parse(text)
    assert Partition.parse(str(partition)) == partition
    return {(i, j) for i in ids for j in ids if i != j and partition.cuts(i, j, ids)}


def test_two_groups() -> None:
    assert cut("1,2,3 | 4,5,6") == {(i, j) for i in (1, 2, 3) for j in (4, 5, 6)} | {
        (j, i) for i in (1, 2, 3) for j in (4, 5, 6)
    }
    assert (1, 3) not in cut("1 | 2")  # who is in no group hears everybody


def test_one_robot_alone() -> None:
    assert cut("alone 4") == {pair for other in (1, 2, 3, 5, 6) for pair in ((4, other), (other, 4))}


def test_a_bridge_hears_both_halves() -> None:
    pairs = cut("bridge 3")
    assert not any(3 in pair for pair in pairs)
    assert pairs == {p for i in (1, 2, 4) for j in (5, 6) for p in ((i, j), (j, i))}


@pytest.mark.parametrize("count", [3, 4, 5, 6, 7])
def test_majorities_each_hear_a_different_one(count: int) -> None:
    ids = tuple(range(1, count + 1))
    pairs = cut("majorities", ids)
    heard = [frozenset(i for i in ids if i == j or (i, j) not in pairs) for j in ids]
    assert all(len(group) == count // 2 + 1 for group in heard)
    assert len(set(heard)) == count


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ('loss = "120%"', 'faults.loss: must be between 0% and 100%, got "120%"'),
        ('delay = "-5ms"', "faults.delay: must not be negative"),
        ('loss = "30"', 'a percentage is written "30%"'),
        ('delay = "fast"', "faults.delay: must be"),
        ("los = 3", "faults.los: unknown field; did you mean loss?"),
        ("clock_skew = 3", "faults.clock_skew: unknown field"),
    ],
)
def test_defaults_that_are_wrong(faults: str, said: str) -> None:
    assert any(said in problem for problem in problems(f"[faults]\n{faults}\n")), problems(
        f"[faults]\n{faults}\n"
    )


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        (
            'link = "1->9"\nloss = "5%"',
            'faults.rule[1].link: "1->9": there is no robot 9; ids are 1, 2, 3, 4',
        ),
        ('robot = 9\nloss = "5%"', "faults.rule[1].robot: 9: there is no robot 9"),
        ('robot = []\nloss = "5%"', "faults.rule[1].robot: names no robot"),
        ('partition = "1,2 | 3,9"', "faults.rule[1].partition"),
        ('partition = "1,2 | 2,3"', "robot 2 is in two groups"),
        ('partition = "1,2"', "must be groups such as"),
        ('link = "1=>2"\nloss = "5%"', 'faults.rule[1].link: must be a link such as "1->2"'),
        ('link = "1->2"', "faults.rule[1]: does nothing: give an effect"),
        ('link = "1->2"\nrobot = 3\nloss = "5%"', "gives link and robot: one of them says where"),
        ('loss = "5%"\nevery = "1s"', "faults.rule[1].every: needs a for"),
        ('loss = "5%"\nevery = "1s"\nfor = "2s"', "is not shorter than every"),
        ('loss = "5%"\nuntil = "9s"', "faults.rule[1].until: is the end of an every"),
        ('loss = "5%"\nat = "9s"\nfor = "1s"\nevery = "2s"\nuntil = "8s"', "is not after the start"),
        ('loss = "5%"\nfor = "-1s"', "faults.rule[1].for: must be between 0.001 and 1000000"),
        ('loss = "0%..50%"', "faults.rule[1].loss: the ramp"),
        ('loss = "0%..gemodel 1%"\nfor = "1s"', "faults.rule[1].loss: must have ends of one kind"),
        ('robot = 3\nclock_skew = "1s"\nat = "5s"', "holds for the whole run"),
        ('kill = "agent"\nat = "5s"', "faults.rule[1].kill: needs a robot"),
        ('robot = 3\nkill = "agent"', "faults.rule[1].kill: needs an at"),
        ('robot = 3\npause = "agent"\nat = "5s"', "faults.rule[1].pause: needs a for"),
        ('robot = 3\nrestart = "agent"\nat = "5s"\nfor = "1s"', "a restart is at once"),
        ('robot = 3\npause = "agent"\nat = 5\nfor = 1\nwipe = true', "wipe: belongs to kill or restart"),
        ("wipe = true", "wipe: belongs to kill or restart"),
        ('robot = 3\nkill = "both agents"\nat = "5s"', "faults.rule[1].kill: must be one of"),
        ('link = "1->2"\njump_m = 0.5', "jump_m is of robots: write robot"),
        ('robot = 3\ntopic = "state"\nrange = "disc 5m"', "a robot has no distance from its own plant"),
        ('partition = "1 | 2"\ntopic = "state"', "a partition is between agents"),
    ],
)
def test_rules_that_are_wrong(rule: str, said: str) -> None:
    found = problems(f"[[faults.rule]]\n{rule}\n")
    assert any(said in problem for problem in found), found


@pytest.mark.parametrize("effect", ['partition="1|1,2"', 'robot=1,at=5,kill="brain"', 'loss="brain"'])
def test_a_rule_whose_effect_is_wrong_is_not_said_to_have_none(effect: str) -> None:
    assert not [each for each in problems("", f"faults.rule=[{{{effect}}}]") if "does nothing" in each]


def test_two_rules_of_one_name() -> None:
    rule = '[[faults.rule]]\nname = "cut"\nloss = "5%"\n'
    assert any('faults.rule[1] has the name "cut" already' in problem for problem in problems(rule + rule))


def test_a_scenario_is_read_with_the_fleets_robots() -> None:
    section = parse_scenario('[[faults.rule]]\nlink = "1->2"\nloss = "30%"\n', IDS)
    assert str(section.rules[0].loss) == "30%"
    for text, said in (
        ('[[faults.rule]]\nlink = "1->9"\nloss = "30%"\n', "no robot 9"),
        ('[fleet]\nname = "x"\n', "unknown table"),
        ("[[faults.rule]\n", "not valid TOML"),
    ):
        with pytest.raises(ScenarioError, match=said):
            parse_scenario(text, IDS)
