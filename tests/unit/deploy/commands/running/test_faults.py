"""`handfast faults`: what is asked for, sent, held and healed; receivers are real, the bus is not."""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable, Sequence
from math import inf

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.fault_rules import Rule
from handfast.agent.fleet.loading import load_fleet, parse_scenario
from handfast.agent.links.ingress import Ingress
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Faults
from handfast.deploy.commands.running.faults import add_arguments
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.faults.live import (
    Held,
    LiveRulesError,
    Receiver,
    receivers,
    rule_of_options,
    rules_of_scenario,
    text_of,
)
from handfast.deploy.faults.rules import next_begin, window, words
from handfast.deploy.session.faults import Putting, clear, names

FLEET = load_fleet(FLEETS / "pair.toml")
IDS = (1, 2, 3)
START_NS = 1_800_000_000 * NS_PER_S
STEP_NS = NS_PER_S // 50


def rule(text: str) -> Rule:
    return parse_scenario(f"[[faults.rule]]\n{text}", IDS).rules[0]


# ---------------------------------------------------------------------- rules


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"link": "1->2", "loss": "30%", "delay": "normal 80ms 20ms"},
            "delay normal 80ms 20ms, loss 30% on 1->2",
        ),
        ({"robot": "1,2", "loss": "0.3"}, "loss 30% on links of robots 1 and 2"),
        ({"robot": "3", "topic": "state", "delay": "5ms"}, "delay 5ms on state, links of robot 3"),
        ({"partition": "1,2 | 3", "for": "2s"}, "partition 1,2 | 3"),
        ({"partition": "alone 3", "delay": "1s"}, "partition alone 3: delay 1s"),
        ({"topic": "all", "loss": "1%"}, "loss 1% on all topics, every link"),
        ({"robot": "1", "position_bias_m": "10cm,-0.2"}, "position_bias_m 0.1 -0.2 of robot 1"),
        ({"tick_jitter": "5ms"}, "tick_jitter 5ms of every robot"),
        ({"link": "1->2", "rate": "1kbit limit 5", "name": "42"}, "rate 1kbit limit 5 on 1->2"),
    ],
)
def test_options_make_a_rule(given: dict[str, str], says: str) -> None:
    made = rule_of_options(given, IDS)
    assert sorted(words(made).split(", ")) == sorted(says.split(", "))
    assert parse_scenario(text_of([made]), IDS).rules == (made,)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"link": "1->9", "loss": "1%"}, '--link: "1->9": there is no robot 9; ids are 1, 2, 3'),
        ({"loss": "120%"}, "--loss: must be between 0% and 100%"),
        ({"delay": "-5ms"}, "--delay: "),
        ({"robot": "1,x", "loss": "1%"}, "--robot[2]: must be a whole number"),
        ({"loss": "1%", "for": "2s", "every": "1s"}, "--for: 2.0 s is not shorter than every"),
        ({"link": "1->2"}, "does nothing: give an effect"),
        (
            {"kill": "agent", "robot": "1"},
            "--kill: processes are killed, paused and restarted by the `handfast run`",
        ),
        ({"clock_skew": "1s"}, "--clock-skew: a clock holds for a whole run"),
    ],
)
def test_what_is_wrong_is_said_by_its_option(given: dict[str, str], says: str) -> None:
    with pytest.raises(LiveRulesError) as refused:
        rule_of_options(given, IDS)
    assert str(refused.value).startswith(says), refused.value


def test_every_field_of_a_rule_has_an_option_with_help(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser(prog="handfast")
    add_arguments(parser)
    options = parser.parse_args(["set", "pair", "--position-bias-m=1,2", "--for", "1s"])
    given = {
        key: value for key, value in vars(options).items() if key.startswith("rule.") and value is not None
    }
    assert given == {"rule.position_bias_m": "1,2", "rule.for": "1s"}
    with pytest.raises(SystemExit):
        parser.parse_args(["set", "--help"])
    text = capsys.readouterr().out
    assert "--duplicate 1%" in text
    assert "--topic hand|state|wrench|all" in text
    assert "--kill" not in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[faults]\n", "s.toml: holds no faults"),
        ("x = [", "s.toml: not valid TOML"),
        ("[control]\nkp = 1\n", "s.toml: control: unknown table"),
        ('[faults]\nseed = 1\nloss = "1%"\n', "s.toml: faults.seed: a running fleet draws with the seed"),
        (
            '[[faults.rule]]\nrobot = 1\npause = "plant"\nat = 1\nfor = 1\n',
            "s.toml: faults.rule[1].pause: processes are killed",
        ),
        (
            '[[faults.rule]]\nlink = "1->7"\nloss = 1\n',
            's.toml: faults.rule[1].link: "1->7": there is no robot 7',
        ),
    ],
)
def test_scenario_that_cannot_be_live(text: str, says: str) -> None:
    with pytest.raises(LiveRulesError) as refused:
        rules_of_scenario(text, "s.toml", IDS)
    assert str(refused.value).startswith(says), refused.value


@pytest.mark.parametrize(
    ("text", "now", "holds", "following"),
    [
        ('loss = "1%"', -5.0, (-inf, inf), None),
        ('loss = "1%"\nfor = 3', -0.1, None, 0.0),
        ('loss = "1%"\nfor = 3', 2.9, (0.0, 3.0), None),
        ('loss = "1%"\nfor = 3', 3.0, None, None),
        ('loss = "1%"\nat = 2', 1.0, None, 2.0),
        ('loss = "1%"\nat = 2', 9.0, (2.0, inf), None),
        ('loss = "1%"\nat = 2\nfor = 1\nevery = 3\nuntil = 9', 5.5, (5.0, 6.0), None),
        ('loss = "1%"\nat = 2\nfor = 1\nevery = 3\nuntil = 9', 6.0, None, 8.0),
        ('loss = "1%"\nat = 2\nfor = 1\nevery = 3\nuntil = 8.5', 8.2, (8.0, 8.5), None),
        ('loss = "1%"\nat = 2\nfor = 1\nevery = 3\nuntil = 8', 6.0, None, None),
    ],
)
def test_when_a_rule_holds(
    text: str, now: float, holds: tuple[float, float] | None, following: float | None
) -> None:
    assert window(rule(text), now) == holds
    assert next_begin(rule(text), now) == following


# ---------------------------------------------------------------------- in force and away again


class World:
    """Agents and plants of a fleet that take live rules, in a time that moves only when somebody waits."""

    def __init__(self) -> None:
        self.now_ns = START_NS
        self.deaf: set[Receiver] = set()
        self.later: list[tuple[int, Callable[[], object]]] = []
        self.sent: list[Faults] = []
        self.receptions = {
            (robot, role): Ingress(FLEET, robot, "agent" if role == "agent" else "plant", {})
            for robot, role in receivers(FLEET)
        }

    def at(self, time_s: float, do: Callable[[], object]) -> None:
        self.later.append((START_NS + round(time_s * NS_PER_S), do))

    def holding(self) -> list[list[str]]:
        """For every receiver, whose rules it holds."""
        return [
            [held.message.author for held in ingress.plan.live if held.rules]
            for ingress in self.receptions.values()
        ]


class Somebody:
    """One operator in the world, a `deploy.session.faults.Operator`."""

    fleet = FLEET

    def __init__(self, world: World, author: str) -> None:
        self.world, self.author = world, author
        self.receivers: Sequence[Receiver] = receivers(FLEET)
        self.held = Held(FLEET)

    def now_ns(self) -> int:
        return self.world.now_ns

    def version(self) -> int:
        return self.world.now_ns // 1_000_000 + len(self.world.sent)

    def send(self, message: Faults) -> None:
        self.world.sent.append(message)
        received = decode(encode(message))
        assert isinstance(received, Faults)
        for receiver, ingress in self.world.receptions.items():
            if receiver not in self.world.deaf:
                ingress.accept(received, self.world.now_ns)

    def collect(self) -> None:
        for key, payload in echoes(self.world):
            for each in everybody:
                each.held.feed(key, decode(payload))

    def pause(self) -> None:
        world = self.world
        world.now_ns += STEP_NS
        for entry in [entry for entry in world.later if entry[0] <= world.now_ns]:
            world.later.remove(entry)
            entry[1]()

    def wait(self, look: Callable[[], bool], timeout_s: float) -> bool:
        deadline_ns = self.world.now_ns + round(timeout_s * NS_PER_S)
        while True:
            self.collect()
            if look():
                return True
            if self.world.now_ns >= deadline_ns:
                return False
            self.pause()


everybody: list[Somebody] = []


def echoes(world: World) -> list[tuple[str, bytes]]:
    return [sent for ingress in world.receptions.values() for sent in ingress.outgoing(world.now_ns)]


@pytest.fixture
def world() -> World:
    everybody.clear()
    return World()


def somebody(world: World, author: str = "ana@lab:1") -> Somebody:
    everybody.append(Somebody(world, author))
    return everybody[-1]


def put(
    who: Somebody, text: str, stream: io.StringIO | None = None, *, stay: bool = False, until_s: float = inf
) -> Putting:
    """Puts one rule into force; the user has enough `until_s` after the start."""
    rules = [rule(text)]
    putting = Putting(
        who,
        rules,
        text_of(rules),
        lambda: who.now_ns() >= START_NS + until_s * NS_PER_S,
        stream or io.StringIO(),
        stay=stay,
    )
    putting.run()
    return putting


def test_a_rule_holds_everywhere_and_heals_at_its_end(world: World) -> None:
    ana, told = somebody(world), io.StringIO()
    world.at(1.0, lambda: held_then.extend(world.holding()))
    held_then: list[list[str]] = []
    putting = put(ana, 'link = "1->2"\nloss = "30%"\nfor = 2', told)
    assert held_then == [["ana@lab:1"]] * 4
    assert putting.took == set(ana.receivers)
    assert not putting.cleared
    assert not putting.early
    assert world.holding() == [[]] * 4
    # It was there until the last message of its time could have come.
    assert world.now_ns >= world.sent[0].origin_ns + 2 * NS_PER_S
    assert told.getvalue() == "loss 30% on 1->2; held by 4 of 4; 2.3 s left\n"


def test_all_receivers_begin_at_the_same_time(world: World) -> None:
    put(somebody(world), 'loss = "30%"\nfor = 1')
    assert {message.origin_ns for message in world.sent} == {START_NS + 3 * NS_PER_S // 10}


def test_without_an_end_it_holds_until_the_user_has_enough(world: World) -> None:
    putting = put(somebody(world), 'loss = "30%"', until_s=7.0)
    assert not putting.early
    assert world.holding() == [[]] * 4
    assert START_NS + 7 * NS_PER_S <= world.now_ns < START_NS + 8 * NS_PER_S


def test_ctrl_c_before_the_end_heals_at_once(world: World) -> None:
    putting = put(somebody(world), 'loss = "30%"\nfor = 60', until_s=3.0)
    assert putting.early
    assert world.holding() == [[]] * 4


def test_stay_ends_when_all_have_it_and_leaves_it(world: World) -> None:
    putting = put(somebody(world), 'loss = "30%"\nfor = 60', stay=True)
    assert putting.missing == []
    assert world.now_ns < START_NS + NS_PER_S
    world.now_ns += 30 * NS_PER_S
    echoes(world)
    assert world.holding() == [["ana@lab:1"]] * 4


def test_a_killed_author_is_healed_by_the_lease(world: World) -> None:
    class KilledError(Exception):
        pass

    def kill() -> None:
        raise KilledError

    world.at(3.0, kill)
    with pytest.raises(KilledError):
        put(somebody(world), 'loss = "30%"')
    last_ns = world.sent[-1].time_ns
    world.now_ns = last_ns + 2 * NS_PER_S - STEP_NS
    echoes(world)
    assert world.holding() == [["ana@lab:1"]] * 4
    world.now_ns = last_ns + 2 * NS_PER_S
    echoes(world)
    assert world.holding() == [[]] * 4


@pytest.mark.parametrize("stay", [False, True])
def test_a_receiver_that_does_not_take_it_is_named(world: World, stay: bool) -> None:
    world.deaf = {(2, "plant")}
    putting = put(somebody(world), 'loss = "30%"\nfor = 1', stay=stay)
    assert putting.missing == [(2, "plant")]
    assert len(putting.took) == 3


@pytest.mark.parametrize(("deaf_from_s", "named"), [(1.0, False), (2.55, True)])
def test_one_that_cannot_be_healed_is_named(world: World, deaf_from_s: float, named: bool) -> None:
    """Unless its lease has ended until then, which it says."""
    told = io.StringIO()
    world.at(deaf_from_s, lambda: world.deaf.add((1, "agent")))
    putting = put(somebody(world), 'loss = "30%"\nfor = 2', told)
    assert putting.missing == []
    says = "not heard to be healed: robot 1's agent; there the lease ends in 2 s"
    assert (says in told.getvalue()) == named


@pytest.mark.parametrize(
    ("author", "lease_ns", "within_s"), [("*", 0, 3.1), ("ana@lab:1", 4 * NS_PER_S, 1.1)]
)
def test_another_operator_ends_it(world: World, author: str, lease_ns: int, within_s: float) -> None:
    ana, bob = somebody(world), somebody(world, "bob@lab:2")
    world.at(5.0, lambda: bob.send(Faults(bob.version(), bob.now_ns(), author, bob.now_ns(), lease_ns, "")))
    putting = put(ana, 'loss = "30%"\nfor = 60')
    assert putting.cleared
    assert world.now_ns <= START_NS + (5.0 + within_s) * NS_PER_S
    assert world.holding() == [[]] * 4


def test_clear_names_who_still_holds_it(world: World) -> None:
    put(somebody(world), 'loss = "30%"', stay=True)
    world.deaf = {(1, "plant"), (2, "agent"), (2, "plant")}
    cleared, left = clear(somebody(world, "bob@lab:2"), None)
    assert cleared == ["ana@lab:1"]
    assert names(left) == "robot 1's plant, robot 2's agent and plant"
