"""What is wrong with faults that are each valid: rules that contradict, never hold, or stop the fleet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

import numpy as np

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.lateness import LATE_MAX_NS
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, Effect, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import start_hands
from handfast.agent.impairments.impairments import Delay
from handfast.agent.links.fault_plan import FaultPlan, LinkEffects
from handfast.agent.messages.types import FUTURE_NS_MAX
from handfast.deploy.check.finding import Finding
from handfast.deploy.check.network import hand_bytes
from handfast.deploy.console.wording import NAMES_SHOWN, robots
from handfast.deploy.faults.rules import acts_on_links, windows, words
from handfast.deploy.recording.tables import Link, links_of

_JITTERS: Final = {"constant": 0.0, "uniform": 1.0}
"""How many jitters a delay may be above its mean; other distributions end at four."""
_EVERYWHERE: Final = "faults"


@dataclass
class _Rule:
    """A rule, its place in the file, and what it is for in this fleet."""

    rule: Rule
    place: str
    times: list[tuple[float, float]]
    effects: Mapping[str, Effect[Any]] = field(default_factory=dict)
    links: set[Link] = field(default_factory=set)


def check_faults(fleet: Fleet) -> Iterator[Finding]:
    """Everything worth saying about the faults of a fleet that was parsed."""
    plan = FaultPlan(fleet)
    end = fleet.fleet.duration_s
    rules = {
        id(rule): _Rule(rule, f"faults.rule[{number}]", windows(rule, end))
        for number, rule in enumerate(plan.file_rules(), 1)
    }
    links = list(links_of(fleet.ids, fleet.formation.edges))
    for link in links:
        for timed in plan.rules_of_link(*link).rules:
            known = rules[id(timed.rule)]
            known.effects = timed.effects
            known.links.add(link)
    every = list(rules.values())
    yield from _times(every, end)
    yield from _nowhere(every)
    yield from _hidden(every)
    yield from _no_start(fleet, plan, links, every)
    everywhere = _defaults(fleet, plan, links, end)
    with_defaults = [*([everywhere] if everywhere is not None else []), *every]
    yield from _late(fleet, with_defaults)
    yield from _processes(fleet, every, end)
    yield from _clocks(fleet, plan)


def _defaults(fleet: Fleet, plan: FaultPlan, links: Iterable[Link], end: float) -> _Rule | None:
    """What ``[faults]`` gives every link between agents, as a rule that always holds."""
    for link in links:
        if link.topic == "hand":
            for name, effects in plan.rules_of_link(*link).asked():
                if name == "[faults]":
                    hands = {each for each in links if each.topic == "hand"}
                    return _Rule(Rule(name=name), _EVERYWHERE, [(0.0, end)], effects, hands)
    return None


def _named(rule: _Rule) -> str:
    return rule.rule.name if rule.place == _EVERYWHERE else f"'{rule.rule.name}'"


# --- when and where ---------------------------------------------------------------------------


def _times(rules: Sequence[_Rule], end: float) -> Iterator[Finding]:
    for each in rules:
        rule = each.rule
        start = rule.at or 0.0
        if not each.times:
            yield Finding(
                "warning",
                f"{each.place}.at",
                f"{_named(each)} begins at {start:g} s, and the run ends at {end:g} s: it never holds",
            )
            continue
        first = max(begin for begin, _ in each.times)
        heals = min(first + (rule.duration or 0.0), inf if rule.until is None else rule.until)
        if rule.duration is not None and not rule.given(ACTION_FIELDS) and heals > end:
            yield Finding(
                "warning",
                f"{each.place}.for",
                f"{_named(each)} heals only after the run's end at {end:g} s (from {first:g} s for "
                f"{rule.duration:g} s): whether the fleet comes back is not seen; end it earlier, or let "
                "the run last longer (fleet.duration_s)",
            )
        elif rule.until is not None and rule.until > end:
            yield Finding(
                "info", f"{each.place}.until", f"{rule.until:g} s is after the run's end at {end:g} s"
            )


def _nowhere(rules: Sequence[_Rule]) -> Iterator[Finding]:
    for each in rules:
        rule = each.rule
        if not acts_on_links(rule) or each.links:
            continue
        where = "link" if rule.link is not None else "partition" if rule.partition is not None else "robot"
        if rule.topic == "hand":
            why = (
                "no edge of the formation joins these robots, so it acts on their beacons; on hand states "
                "only while they are near each other, or once an order joins them"
            )
        else:
            why = (
                f"{rule.topic} is between a robot's agent and its own plant: write robot = ... or a link "
                'such as "3->3"'
            )
        yield Finding(
            "warning", f"{each.place}.{where}", f"{_named(each)} ({words(rule)}) is for no link: {why}"
        )


def _hidden(rules: Sequence[_Rule]) -> Iterator[Finding]:
    """Effects of rules that never take effect, as one rule before them always gives another value."""
    for k, later in enumerate(rules):
        for first in rules[:k]:
            for name in first.effects.keys() & later.effects.keys():
                one, other = str(first.effects[name]), str(later.effects[name])
                if one != other and later.links <= first.links and _covers(first.times, later.times):
                    yield Finding(
                        "warning",
                        later.place,
                        f"{name} of {_named(later)} ({other}) never takes effect: {_named(first)} ({one}) "
                        "comes first in the file and holds on all of its links; put the narrower rule first",
                    )


def _covers(a: Sequence[tuple[float, float]], b: Sequence[tuple[float, float]]) -> bool:
    """Whether every window of `b` lies within one of `a`."""
    return all(any(start <= first and last <= end for start, end in a) for first, last in b)


# --- what a fleet does not survive -------------------------------------------------------------


def _no_start(
    fleet: Fleet, plan: FaultPlan, links: Sequence[Link], rules: Sequence[_Rule]
) -> Iterator[Finding]:
    """Links on which nothing comes from before the start on: robots wait for each neighbour, and for ever."""
    apart = _start_distances(fleet)
    silent: dict[str, list[tuple[Link, str]]] = {}
    for link in links:
        link_rules = plan.rules_of_link(*link)
        if link_rules.idle:
            continue
        effects = link_rules.effects(0)
        why = _deaf(effects, apart.get((link.source, link.destination)))
        if not why and link.topic == "hand":
            why = _too_old(effects, fleet.control.prediction_horizon_s)
        if not why:
            continue
        effect = why.partition(" ")[0]
        place = next(
            (
                f"{each.place}.{effect if getattr(each.rule, effect) is not None else 'partition'}"
                for each in rules
                if link in each.links and effect in each.effects and _always(each.rule)
            ),
            f"{_EVERYWHERE}.{effect}",
        )
        silent.setdefault(place, []).append((link, why))
    for place, found in silent.items():
        link, why = found[0]
        is_late = why.startswith("delay")
        either = "are as late" if is_late else "carry nothing either"
        others = f", and {len(found) - 1} further links {either}" if len(found) > 1 else ""
        robot = link.destination
        if link.topic == "hand":
            in_time = " in time" if is_late else ""
            text = (
                f"robot {robot} never hears robot {link.source}{in_time}{others} ({why}): the fleet cannot "
                "start"
            )
        elif link.topic == "state":
            text = f"robot {robot}'s agent never hears its plant{others} ({why}): the fleet cannot start"
        else:
            text = f"robot {robot}'s plant never gets a command{others} ({why}): it will not move"
        yield Finding("error", place, f"{text}; give an at, or less")


def _always(rule: Rule) -> bool:
    """Whether a rule holds from before the start on, without an end."""
    return rule.at is None and rule.duration is None


def _deaf(effects: LinkEffects, distance: float | None) -> str:
    """Why no message ever comes through, "" when some do."""
    if effects.loss is not None and effects.loss.rate > 1.0 - 1e-9:
        return f"loss {effects.loss}"
    if effects.range is not None and distance is not None and effects.range.failure(distance) > 1.0 - 1e-9:
        return f"range {effects.range}; they start {distance:.3g} m apart"
    return ""


def _too_old(effects: LinkEffects, horizon_s: float) -> str:
    """Why every message is so old that its sender counts as silent, "" when that is not certain."""
    delay, most_s = effects.delay, horizon_s + LATE_MAX_NS / NS_PER_S
    if delay is None or effects.reorder is not None:
        return ""
    if delay.mean - _JITTERS.get(delay.distribution, 4.0) * delay.jitter <= most_s:
        return ""
    return (
        f"delay {delay}; at {most_s:g} s, control.prediction_horizon_s and the {LATE_MAX_NS / NS_PER_S:g} s "
        "that a link is forgiven for being late as usual, a robot counts as silent"
    )


def _start_distances(fleet: Fleet) -> Mapping[tuple[int, int], float]:
    """Distance of the hand points at the start, m, by the robots of each edge both ways."""
    hands = dict(zip((robot.id for robot in fleet.members), start_hands(fleet), strict=True))
    out = {}
    for i, j in fleet.formation.edges:
        if i in hands and j in hands:
            out[i, j] = out[j, i] = float(np.hypot(*(hands[i] - hands[j])))
    return out


def _late(fleet: Fleet, rules: Sequence[_Rule]) -> Iterator[Finding]:
    """Delays, silences and queues against how long a robot tolerates them."""
    control = fleet.control
    tolerated = {
        "hand": (
            control.prediction_horizon_s, "control.prediction_horizon_s",
            "a robot that hears nothing newer of a neighbour "
            + ("holds (brakes)" if fleet.supervision.silence == "hold" else "drives on without that edge"),
        ),
        "state": (
            control.plant_timeout_s, "control.plant_timeout_s",
            "an agent that hears nothing newer of its plant is in fault (brakes)",
        ),
        "wrench": (
            control.wrench_timeout_s, "control.wrench_timeout_s",
            "a plant that hears nothing newer of its agent brakes",
        ),
    }  # fmt: skip
    for each in rules:
        for topic in sorted({link.topic for link in each.links}):
            limit, name, then = tolerated[topic]
            consequence = f"{name} = {limit:g} s: {then}"
            yield from _delayed(each, topic, limit, consequence)
            silent = _silence(each)
            if silent is not None and silent > limit:
                yield Finding(
                    "info" if topic == "hand" else "warning",
                    each.place,
                    f"{_named(each)} lets nothing through on {_some(each.links, topic)} for {silent:g} s, "
                    f"longer than {consequence} until it heals",
                )
        yield from _crowded(fleet, each)


def _some(links: Iterable[Link], topic: str) -> str:
    chosen = sorted(f"{link.source}->{link.destination}" for link in links if link.topic == topic)
    shown = ", ".join(chosen[:NAMES_SHOWN])
    more = f" and {len(chosen) - NAMES_SHOWN} more" if len(chosen) > NAMES_SHOWN else ""
    return f"{shown}{more}" if topic == "hand" else f"{topic} of {shown}{more}"


def _ends(effect: Effect[Any]) -> list[Any]:
    """A setting, or both ends of its ramp."""
    return [effect.start] if effect.end is None else [effect.start, effect.end]


def _delayed(each: _Rule, topic: str, limit: float, consequence: str) -> Iterator[Finding]:
    effect = each.effects.get("delay")
    if effect is None:
        return
    delays: list[Delay] = _ends(effect)
    most = max(delay.mean + _JITTERS.get(delay.distribution, 4.0) * delay.jitter for delay in delays)
    if most >= limit:
        yield Finding(
            "warning",
            f"{each.place}.delay",
            f"{_named(each)}: {topic} comes up to {most:g} s late; {consequence}",
        )


def _silence(each: _Rule) -> float | None:
    """For how long a rule lets nothing through, s; None when some come, or none ever (`_no_start`)."""
    loss = each.effects.get("loss")
    cut = loss is not None and loss.end is None and loss.start.rate > 1.0 - 1e-9
    if not each.times or _always(each.rule) or not cut:
        return None
    return max(last - first for first, last in each.times)


def _crowded(fleet: Fleet, each: _Rule) -> Iterator[Finding]:
    """Rate limits below what messages need: their queue grows until it is full."""
    effect = each.effects.get("rate")
    if effect is None or not any(link.topic == "hand" for link in each.links):
        return
    degree = max(sum(robot in edge for edge in fleet.formation.edges) for robot in fleet.ids)
    ids = set(fleet.ids[:degree])
    size = hand_bytes(fleet, ids, ids)
    needed = 8.0 * size * fleet.fleet.rate_hz
    least = min(one.bits_per_second for one in _ends(effect))
    if least < needed:
        yield Finding(
            "warning",
            f"{each.place}.rate",
            f"{_named(each)}: {least / 1e3:g} kbit/s is less than the {needed / 1e3:.3g} kbit/s that hand "
            f"states take at {fleet.fleet.rate_hz:g} Hz: they come ever later until the queue is full "
            "(limit), and then some are lost; take more, or a short limit",
        )


# --- processes and clocks ---------------------------------------------------------------------


def _what_follows(fleet: Fleet, rule: Rule) -> str:
    """What becomes of a drive of which a robot's process is killed for good."""
    if rule.kill == "plant":
        return "its place is not known, and the verdict fails unless another robot takes its place"
    if fleet.supervision.silence == "hold":
        return "its neighbours hold (brake), and the verdict fails"
    if rule.kill == "both":
        return "its place is not known, of which the verdict warns, and the others go on without it"
    return "it stands where it braked, and the others go on without it"


def _processes(fleet: Fleet, rules: Sequence[_Rule], end: float) -> Iterator[Finding]:
    for each in rules:
        rule = each.rule
        if not each.times:
            continue
        who = robots(fleet.ids if rule.robots is None else rule.robots)
        if rule.kill is not None and (rule.duration is None or each.times[-1][0] + rule.duration >= end):
            yield Finding(
                "warning",
                f"{each.place}.kill",
                f"{_named(each)}: what is killed of {who} at {each.times[-1][0]:g} s is not started again "
                f"before the run's end at {end:g} s: {_what_follows(fleet, rule)}; give a for to have "
                "it back",
            )
        if rule.pause is not None and rule.duration is not None and each.times[-1][0] + rule.duration > end:
            yield Finding(
                "warning",
                f"{each.place}.pause",
                f"{_named(each)}: {who} is still paused at the run's end at {end:g} s; end it earlier",
            )
        period = 1.0 / fleet.fleet.rate_hz
        if rule.tick_jitter is not None and rule.tick_jitter.most_s >= period:
            yield Finding(
                "warning",
                f"{each.place}.tick_jitter",
                f"{rule.tick_jitter} is not less than a period, {period:g} s: ticks will be missed",
            )


def _clocks(fleet: Fleet, plan: FaultPlan) -> Iterator[Finding]:
    """Report the pair of neighbours whose clocks differ most, at the start or at the end of the run."""
    limit = FUTURE_NS_MAX / NS_PER_S
    found = [
        (_ahead_s(plan, *pair, after_s), -after_s, pair)
        for after_s in (0.0, fleet.fleet.duration_s)
        for i, j in fleet.formation.edges
        for pair in ((i, j), (j, i))
    ]
    ahead_s, after_s, (i, j) = max(found, default=(0.0, 0.0, (0, 0)))
    if ahead_s <= limit:
        return
    number = next(
        number
        for number, rule in enumerate(plan.file_rules(), 1)
        if rule.clock_skew is not None and (rule.robots is None or {i, j} & set(rule.robots))
    )
    late = any("delay" in effects for _, effects in plan.rules_of_link(i, j, "hand").asked())
    unless = "unless they are late, " if late else ""
    at_start = _ahead_s(plan, i, j, 0.0) > limit
    follows = "the fleet cannot start" if at_start else "they are lost"
    yield Finding(
        "error" if at_start and not late else "warning",
        f"faults.rule[{number}].clock_skew",
        f"robot {i}'s clock is {ahead_s:.3g} s ahead of that of its neighbour {j} after {-after_s:g} s. It "
        f"refuses messages from more than {limit:g} s in the future: {unless}{follows}",
    )


def _ahead_s(plan: FaultPlan, i: int, j: int, after_s: float) -> float:
    """Return by how many seconds the clock of i is ahead of that of j, `after_s` seconds after the start."""
    (skew_i, drift_i), (skew_j, drift_j) = plan.clock(i), plan.clock(j)
    return (skew_i - skew_j) / NS_PER_S + (drift_i - drift_j) * after_s
