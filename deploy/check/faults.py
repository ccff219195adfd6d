"""What is wrong with faults that are each valid: rules that contradict, never hold, or stop the fleet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.lateness import LATE_MAX_NS
from handfast.agent.fleet.fault_rules import ACTION_FIELDS, Effect, Rule
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import start_hands
from handfast.agent.impairments.impairments import Delay, Loss
from handfast.agent.links.fault_plan import FaultPlan, LinkEffects
from handfast.agent.messages.types import FUTURE_NS_MAX
from handfast.deploy.check.finding import Finding, Level
from handfast.deploy.check.network import hand_bytes
from handfast.deploy.console.wording import NAMES_SHOWN, robots
from handfast.deploy.faults.rules import acts_on_links, windows, words
from handfast.deploy.recording.tables import Link, links_of

CONTRADICTIONS_MAX: Final = 12
"""So many are said one by one."""
SILENCES_WARN: Final = 0.05
"""Silences beyond the horizon expected in one run, from which on they are warned of."""
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
    yield from _contradictions(every)
    yield from _no_start(fleet, plan, links, every)
    everywhere = _defaults(fleet, plan, links, end)
    with_defaults = [*([everywhere] if everywhere is not None else []), *every]
    yield from _never_late(plan, with_defaults)
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


def _contradictions(rules: Sequence[_Rule]) -> Iterator[Finding]:
    """Rules that give one link different values of one effect at one time; the first of them wins."""
    found: list[Finding] = []
    for k, later in enumerate(rules):
        for first in rules[:k]:
            for name in first.effects.keys() & later.effects.keys():
                finding = _contradiction(first, later, name)
                if finding is not None:
                    found.append(finding)
    yield from found[:CONTRADICTIONS_MAX]
    if len(found) > CONTRADICTIONS_MAX:
        yield Finding(
            "warning",
            "faults.rule",
            f"{len(found) - CONTRADICTIONS_MAX} further pairs of rules give different values of one effect "
            "at the same place and time",
        )


def _contradiction(first: _Rule, later: _Rule, name: str) -> Finding | None:
    one, other = str(first.effects[name]), str(later.effects[name])
    common = first.links & later.links
    moment = _overlap(first.times, later.times)
    if one == other or not common or moment is None:
        return None
    link = min(common, key=lambda each: (each.topic, each))
    way = _some([link], link.topic)
    said = (
        f"{_named(first)} and {_named(later)} give {way} different values of {name} from {moment:g} s on: "
        f"{one} and {other}; the one that comes first in the file, {_named(first)}, wins"
    )
    if later.links <= common and _covers(first.times, later.times):
        return Finding(
            "warning",
            later.place,
            f"{said}. So {name} of {_named(later)} never takes effect: put the narrower rule first",
        )
    narrower = first.links <= common and _covers(later.times, first.times)
    level: Level = "info" if narrower else "warning"
    return Finding(level, later.place, said)


def _overlap(a: Sequence[tuple[float, float]], b: Sequence[tuple[float, float]]) -> float | None:
    """The first moment within a window of each; both ascend."""
    i = j = 0
    while i < len(a) and j < len(b):
        start, end = max(a[i][0], b[j][0]), min(a[i][1], b[j][1])
        if start < end:
            return start
        if a[i][1] <= b[j][1]:
            i += 1
        else:
            j += 1
    return None


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
            yield from _gaps(fleet, each, topic, limit, name, then)
        yield from _crowded(fleet, each)


def _never_late(plan: FaultPlan, rules: Iterable[_Rule]) -> Iterator[Finding]:
    """Messages that are to overtake others where none of these ever waits, which netem refuses."""
    for each in rules:
        waits = (
            "delay" in effects for link in each.links for _, effects in plan.rules_of_link(*link).asked()
        )
        if "reorder" in each.effects and each.links and not any(waits):
            yield Finding(
                "warning",
                f"{each.place}.reorder",
                f"{_named(each)}: reorder sends some messages at once while the others wait their delay, and "
                "there is none: it does nothing; give a delay",
            )


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
    usual = max(delay.mean for delay in delays)
    most = max(delay.mean + _JITTERS.get(delay.distribution, 4.0) * delay.jitter for delay in delays)
    place = f"{each.place}.delay"
    if usual >= limit:
        yield Finding(
            "warning",
            place,
            f"{_named(each)}: {topic} comes {usual:g} s late, more than {consequence}, all the time",
        )
    elif most >= limit:
        yield Finding("warning", place, f"{_named(each)}: {topic} comes up to {most:g} s late; {consequence}")
    elif topic != "hand" and usual >= 0.5 * limit:
        yield Finding(
            "warning",
            place,
            f"{_named(each)}: {topic} comes {usual:g} s late, which leaves little of {consequence}",
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


def _gaps(fleet: Fleet, each: _Rule, topic: str, limit: float, name: str, then: str) -> Iterator[Finding]:
    """Losses so high that by chance alone nothing comes for longer than a robot tolerates."""
    effect = each.effects.get("loss")
    if effect is None:
        return
    delay = each.effects.get("delay")
    rate = fleet.fleet.rate_hz
    left = limit - (max(one.mean for one in _ends(delay)) if delay is not None else 0.0)
    loss: Loss = max(_ends(effect), key=lambda one: float(one.rate))
    links = sum(link.topic == topic for link in each.links)
    hourly = 3600.0 * rate * links * silences(loss, max(int(left * rate), 1))
    held = sum(last - first for first, last in each.times)
    one = f"one of {links} link{'s' * (links != 1)}"
    what = f"nothing will come on {one} for longer" if left == limit else f"the last over {one} will be older"
    if left > 0.0 and loss.rate < 1.0 - 1e-9 and hourly * held / 3600.0 > SILENCES_WARN:
        often = f"{hourly:.3g} times an hour" if hourly < 3600.0 else f"{hourly / 3600.0:.3g} times a second"
        yield Finding(
            "warning",
            f"{each.place}.loss",
            f"{_named(each)} ({loss}): by chance {what} than {name} = {limit:g} s, about {often}; {then}",
        )


def silences(loss: Loss, length: int) -> float:
    """How often at least `length` messages in a row are lost, per message.

    With the chain's matrix T and the loss of each state on a diagonal L: pi (1 - L) (T L)^length summed.
    """
    numbers = loss.numbers
    if loss.kind == "every":
        return 0.0
    if loss.kind == "random":
        p, c = numbers
        enter = p * (1.0 - c)
        move, lost = [[1.0 - enter, enter], [1.0 - enter - c, enter + c]], [0.0, 1.0]
    elif loss.kind == "gemodel":
        p, r, bad, good = numbers
        move, lost = [[1.0 - p, p], [r, 1.0 - r]], [good, bad]
    else:
        p13, p31, p32, p23, p14 = numbers
        move = [
            [1.0 - p13 - p14, 0.0, p13, p14],
            [0.0, 1.0 - p23, p23, 0.0],
            [p31, p32, 1.0 - p31 - p32, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ]
        lost = [0.0, 0.0, 1.0, 1.0]
    matrix, losing = np.array(move), np.array(lost)
    share = _stationary(matrix)
    after = (share * (1.0 - losing)) @ np.linalg.matrix_power(matrix * losing, length)
    return float(after.sum())


def _stationary(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    n = len(matrix)
    equations = np.vstack([matrix.T - np.eye(n), np.ones(n)])
    share: NDArray[np.float64] = np.linalg.lstsq(equations, np.array([0.0] * n + [1.0]), rcond=None)[0]
    return share


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
    limit = FUTURE_NS_MAX / 1e9
    worst: tuple[float, int, int] | None = None
    for i, j in fleet.formation.edges:
        ahead = (plan.clock(i)[0] - plan.clock(j)[0]) / 1e9
        found = (ahead, i, j) if ahead > 0 else (-ahead, j, i)
        worst = found if worst is None or found > worst else worst
    if worst is not None and worst[0] > limit:
        ahead, i, j = worst
        number = next(
            number
            for number, rule in enumerate(plan.file_rules(), 1)
            if rule.clock_skew is not None and (rule.robots is None or {i, j} & set(rule.robots))
        )
        late = any("delay" in effects for _, effects in plan.rules_of_link(i, j, "hand").asked())
        yield Finding(
            "warning" if late else "error",
            f"faults.rule[{number}].clock_skew",
            f"robot {i}'s clock is {ahead:g} s ahead of that of its neighbour {j}, which refuses messages "
            f"from more than {limit:g} s in the future: "
            + ("unless they are late by the rest, " if late else "")
            + "the fleet cannot start",
        )
        return
    drifts = [_apart_from(plan, i, j, limit) for i, j in fleet.formation.edges]
    after_s, ahead, behind = min(drifts, default=(inf, 0, 0))
    if after_s < fleet.fleet.duration_s:
        number = next(
            n for n, rule in enumerate(plan.file_rules(), 1) if rule.clock_skew and rule.clock_skew.drift
        )
        yield Finding(
            "warning",
            f"faults.rule[{number}].clock_skew",
            f"after {after_s:.3g} s robot {ahead}'s clock is {limit:g} s ahead of that of its neighbour "
            f"{behind}, which refuses messages from more than that in the future: they are lost",
        )


def _apart_from(plan: FaultPlan, i: int, j: int, limit: float) -> tuple[float, int, int]:
    """When the clock of one of two is `limit` ahead of the other's: s, inf for never; whose; of whose."""
    (skew_i, drift_i), (skew_j, drift_j) = plan.clock(i), plan.clock(j)
    ahead, drift = (skew_i - skew_j) / 1e9, drift_i - drift_j
    if drift < 0.0:
        return (limit + ahead) / -drift, j, i
    return ((limit - ahead) / drift if drift > 0.0 else inf), i, j
