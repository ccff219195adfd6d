"""The command ``handfast faults``: faults on the links of a fleet that is running."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from math import isinf
from typing import TYPE_CHECKING, Literal, get_args, get_origin

from handfast.agent.common.errors import FAILED, INTERRUPTED, PASSED
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import read_text
from handfast.agent.fleet.model import Fleet
from handfast.deploy.console.arguments import InputError, describe, scenario_path
from handfast.deploy.inventory.known_fleets import MEANING, handled, running_fleet

if TYPE_CHECKING:
    from handfast.agent.common.settings import Entry
    from handfast.agent.fleet.fault_rules import Rule
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.session.faults import FaultsSession


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast faults`` takes."""
    from handfast.deploy.faults.live import NOT_LIVE, live_entries, option

    describe(
        parser,
        f". {MEANING} Exit status: 0 all agents and plants did so; 1 "
        "some did not; 2 bad input; 130 after Ctrl-C before the end.",
    )
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, command: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        sub: argparse.ArgumentParser = actions.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}."
        )
        sub.set_defaults(command=handled(command))
        sub.add_argument("fleet", metavar="FLEET", help="a fleet that is running")
        return sub

    sub = add("set", _set, "set one rule, until it ends, Ctrl-C, or the end of this command")
    _add_stay(sub)
    group = sub.add_argument_group(
        "the rule", "Fields of [[faults.rule]] in a fleet file (docs/faults.md); times count from now."
    )
    for entry in live_entries():
        about = entry.setting.doc.replace("`", "'").replace("%", "%%")
        if entry.hint is bool:
            group.add_argument(
                option(entry.key), dest=_dest(entry.key), action="store_const", const="true", help=about
            )
        else:
            group.add_argument(option(entry.key), dest=_dest(entry.key), metavar=_metavar(entry), help=about)
    for key in NOT_LIVE:
        sub.add_argument(option(key), dest=_dest(key), help=argparse.SUPPRESS)
    sub = add("apply", _apply, "set the rules of a scenario file, until they end, Ctrl-C, or the end of this")
    sub.add_argument("file", metavar="FILE", help="a file of faults, or a bundled scenario")
    _add_stay(sub)
    add("show", _show, "say which faults hold now")
    sub = add("clear", _clear, "heal: end the live rules of all operators")
    sub.add_argument("--author", metavar="WHO", help="only theirs, as `show` names them")


def _add_stay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stay", action="store_true", help="end at once and leave the rules in force until `faults clear`"
    )


def _metavar(entry: Entry) -> str:
    if get_origin(entry.hint) is Literal:
        return "|".join(get_args(entry.hint))
    return (entry.setting.example or entry.setting.unit or entry.key.upper()).strip('"')


def _dest(key: str) -> str:
    return f"rule.{key}"


# ---------------------------------------------------------------------- set and apply


def _set(options: argparse.Namespace) -> int:
    from handfast.deploy.faults.live import rule_of_options

    fleet = running_fleet(options.fleet)
    given = {
        name.removeprefix("rule."): value
        for name, value in vars(options).items()
        if name.startswith("rule.") and value is not None
    }
    return _put(fleet, [rule_of_options(given, fleet.ids)], stay=options.stay)


def _apply(options: argparse.Namespace) -> int:
    from handfast.deploy.faults.live import rules_of_scenario

    fleet = running_fleet(options.fleet)
    path = scenario_path(options.file)
    rules = rules_of_scenario(read_text(path, "scenario"), path.name, fleet.ids)
    return _put(fleet, rules, stay=options.stay)


def _put(fleet: Fleet, rules: Sequence[Rule], *, stay: bool) -> int:
    """Sends the rules, and keeps them in force until they end."""
    from handfast.deploy.console.interrupt import Interrupt
    from handfast.deploy.faults.live import text_of
    from handfast.deploy.session.faults import Putting, names

    text = text_of(rules)
    interrupt = Interrupt()
    with interrupt.caught(), _connected(fleet, interrupt) as session:
        putting = Putting(session, rules, text, lambda: interrupt.count > 0, sys.stderr, stay=stay)
        putting.run()
    total = len(session.receivers)
    print(f"{len(putting.took)} of {total} agents and plants of {fleet.fleet.name} took it")
    if putting.missing:
        print(f"  not: {names(putting.missing)}")
    if putting.cleared:
        print("  ended by another operator before its time")
    if putting.early:
        return INTERRUPTED
    return FAILED if putting.cleared or putting.missing else PASSED


def _connected(fleet: Fleet, interrupt: Interrupt | None = None) -> FaultsSession:
    """A session in which all receivers are there, or as many as came; raises as `connected`."""
    from handfast.deploy.session.faults import FaultsSession
    from handfast.deploy.session.session import connected

    return connected(FaultsSession(fleet), interrupt)


# ---------------------------------------------------------------------- show and clear


def _show(options: argparse.Namespace) -> int:
    from handfast.agent.links.fault_plan import FaultPlan
    from handfast.deploy.faults.rules import defaults
    from handfast.deploy.session.faults import ECHO_S, names

    fleet = running_fleet(options.fleet)
    with _connected(fleet) as session:
        session.wait(lambda: False, ECHO_S)
        now_ns = session.now_ns()
        time_s = None if session.epoch_ns is None else (now_ns - session.epoch_ns) / NS_PER_S
        at = "" if time_s is None else f" at {time_s:.1f} s"
        total = len(session.receivers)
        print(f"{fleet.fleet.name}{at}: {len(session.alive)} of {total} agents and plants answer")
        absent = [each for each in session.receivers if each not in session.alive]
        if absent:
            print(f"  not: {names(absent)}")
        everywhere = defaults(fleet.faults)
        rules = [*FaultPlan(fleet).file_rules(), *([] if everywhere is None else [everywhere])]
        print("in its fleet file:" if rules else "in its fleet file: none")
        for rule in rules:
            print(f"  {rule.name}: {_line_of(rule, time_s)}")
        sets = session.held.sets(now_ns)
        print("live:" if sets else "live: none")
        for each in sets:
            stays = "until cleared" if not each.message.lease_ns else "as long as that command lives"
            print(f"  {each.message.author}, {stays}, held by {len(each.holders)} of {total}:")
            lacking = [r for r in session.receivers if r in session.alive and r not in each.holders]
            if lacking:
                print(f"    not by {names(lacking)}")
            for rule in each.rules:
                name = f"{rule.name}: " if rule.name else ""
                print(f"    {name}{_line_of(rule, each.time_s(now_ns))}")
    return PASSED


def _line_of(rule: Rule, time_s: float | None) -> str:
    """A rule and how it stands at the time that its `at` counts in; None before that is known."""
    from handfast.deploy.faults.rules import next_begin, window, words

    if time_s is None:
        always = rule.at is None and rule.duration is None
        return f"{words(rule)} ({'holds' if always else 'not yet: no mission'})"
    found = window(rule, time_s)
    if found is not None:
        left = "" if isinf(found[1]) else f", {found[1] - time_s:.1f} s left"
        return f"{words(rule)} (holds{left})"
    begin_s = next_begin(rule, time_s)
    return f"{words(rule)} ({'over' if begin_s is None else f'begins in {begin_s - time_s:.1f} s'})"


def _clear(options: argparse.Namespace) -> int:
    from handfast.deploy.session.faults import NothingToClearError, clear, names

    fleet = running_fleet(options.fleet)
    with _connected(fleet) as session:
        try:
            authors, left = clear(session, options.author)
        except NothingToClearError as error:
            raise InputError(str(error)) from None
    for author in authors:
        print(f"cleared the live faults of {author}")
    if not authors:
        print(f"{fleet.fleet.name} has no live faults")
    if left:
        print(f"  not heard to be healed: {names(left)}")
    return FAILED if left else PASSED
