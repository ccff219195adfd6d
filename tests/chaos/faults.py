"""Random faults: of links, processes, clocks and sensors. Times in s of the drive.

Each feature adds rules to a scene, and the orders with which an operator answers them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from tests.chaos.dice import Dice, Range, Tables
from tests.chaos.encounters import draw_rolling
from tests.chaos.scene import Scene

_COUNTS: Final = ((1, 2.0), (2, 3.0), (3, 3.0), (4, 2.0), (6, 1.0), (8, 0.5))
_KINDS: Final = (
    ("link", 6.0), ("partition", 3.0), ("range", 1.0), ("process", 6.0), ("own", 1.5), ("clock", 1.5),
    ("jitter", 1.0), ("dropout", 0.7),
)  # fmt: skip
_PAUSE_MAX_S: Final = 3.0
_DOWN_MAX_S: Final = 6.0
_CUT_MAX_S: Final = 6.0
_BEGIN_S: Final = 0.5
"""Minimum time from the beginning of a fault to the end of the trouble."""
_FORGOTTEN_S: Final = 60.0
_REMOVED: Final = 0.3
"""Share of the scenarios with deaths in which bodies are carried off."""
_PATIENT_PERIODS: Final = 10.0


# --- any fault --------------------------------------------------------------------------------------


def draw_any(scene: Scene) -> None:
    """Add some faults of any kind, most of them over when the trouble ends."""
    for _ in range(scene.dice.weighted(_COUNTS)):
        kind = scene.dice.weighted(_KINDS)
        scene.add_rule(kind, _RULES[kind](scene.dice, scene.ids, scene.trouble_s))
    scene.last_s = max(scene.last_s, scene.trouble_s)


def _ms(dice: Dice, low: int, high: int) -> str:
    return f"{dice.whole(low, high)}ms"


def _percent(dice: Dice, low: float, high: float) -> str:
    return f"{dice.between(low, high, 1):g}%"


def _window(dice: Dice, trouble_s: float, longest_s: float, least_s: float = 0.2) -> Tables:
    at = dice.between(0.0, trouble_s - _BEGIN_S, 2)
    return {"at": at, "for": min(dice.between(least_s, longest_s, 2), round(trouble_s - at, 2))}


def _flapping(dice: Dice, trouble_s: float) -> Tables:
    """Return the fields of a rule that comes and goes until the trouble ends."""
    at, lasts = dice.between(0.0, trouble_s - _BEGIN_S, 2), dice.between(0.2, 1.2, 2)
    return {"at": at, "for": lasts, "every": round(lasts + dice.between(0.2, 2.0), 2), "until": trouble_s}


def _link(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    """Return a rule with one or two effects on links between agents."""
    where = dice.weighted((("all", 3.0), ("robot", 2.0), ("one", 2.0), ("from", 1.0), ("to", 1.0)))
    rule: Tables = {}
    if where == "robot":
        rule = {"robot": dice.pick(ids)}
    elif where == "one" and len(ids) > 1:
        a, b = dice.some(ids, 2)
        rule = {"link": f"{a}{dice.pick(('->', '<->'))}{b}"}
    elif where in ("from", "to"):
        rule = {"link": f"{dice.pick(ids)}->*" if where == "from" else f"*->{dice.pick(ids)}"}
    if dice.chance(0.7):
        rule |= _window(dice, trouble_s, trouble_s) if dice.chance(0.7) else _flapping(dice, trouble_s)
    for _ in range(1 if dice.chance(0.6) else 2):
        rule |= _effect(dice, windowed="for" in rule)
    return rule


def _effect(dice: Dice, *, windowed: bool) -> Tables:
    kind = dice.weighted(
        (("delay", 4.0), ("loss", 4.0), ("duplicate", 1.0), ("reorder", 1.0), ("corrupt", 1.0))
    )
    if kind == "delay":
        mean = dice.whole(10, 300)
        form = dice.pick(("{m}ms", "{m}ms {j}ms", "normal {m}ms {j}ms", "pareto {m}ms {j}ms 25%"))
        return {"delay": form.format(m=mean, j=min(dice.whole(1, 100), mean))}
    if kind == "loss":
        if windowed and dice.chance(0.15):
            return {"loss": "100%"}
        form = dice.pick(("{p}", "{p} 25%", "gemodel 5% 20%", "state 2% 10%", "every 3"))
        return {"loss": form.format(p=_percent(dice, 1.0, 40.0))}
    if kind == "reorder":
        return {"reorder": _percent(dice, 5.0, 40.0), "delay": _ms(dice, 20, 200)}
    return {kind: _percent(dice, 1.0, 40.0) if kind == "duplicate" else _percent(dice, 0.1, 5.0)}


def _partition(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    kinds = ["alone", *["groups", "groups", "bridge"] * (len(ids) >= 3), *["majorities"] * (len(ids) >= 5)]
    kind = dice.pick(kinds)
    if kind == "groups":
        text = " | ".join(_split(dice, ids))
    else:
        text = kind if kind == "majorities" else f"{kind} {dice.pick(ids)}"
    window = _window(dice, trouble_s, _CUT_MAX_S) if dice.chance(0.7) else _flapping(dice, trouble_s)
    return {"partition": text, **window}


def _split(dice: Dice, ids: Sequence[int]) -> tuple[str, str]:
    first = dice.some(ids, dice.whole(1, len(ids) - 1))
    return _names(first), _names([robot for robot in ids if robot not in first])


def _names(ids: Sequence[int]) -> str:
    return ",".join(map(str, ids))


def _range(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    form = dice.pick(("disc {m}m", "logdistance {m}m exponent 2.7 shadowing 3dB"))
    return {"range": form.format(m=dice.between(3.0, 8.0, 1)), **_window(dice, trouble_s, _CUT_MAX_S)}


def _process(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    """Return a rule that kills, starts again or pauses a process."""
    role = dice.weighted((("agent", 4.0), ("plant", 2.0), ("both", 1.0)))
    what = dice.weighted((("kill", 3.0), ("pause", 3.0), ("restart", 2.0), ("for good", 0.3)))
    rule: Tables = {"robot": dice.pick(ids)}
    if what in ("restart", "for good"):
        return {**rule, "kill" if what == "for good" else what: role, "at": dice.between(0.0, trouble_s, 2)}
    longest = _PAUSE_MAX_S if what == "pause" else _DOWN_MAX_S
    return {**rule, what: role, **_window(dice, trouble_s, longest, 0.1)}


def _own(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    """Return a rule about messages between a robot's agent and its plant."""
    rule: Tables = {"robot": dice.pick(ids), "topic": dice.pick(("state", "wrench"))}
    rule |= {"delay": _ms(dice, 5, 40)} if dice.chance(0.5) else {"loss": _percent(dice, 1.0, 20.0)}
    return rule | _window(dice, trouble_s, trouble_s)


def _clock(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    skew, drift = dice.between(-0.03, 0.03, 4), dice.between(-1e-4, 1e-4, 6)
    return {"robot": dice.pick(ids), "clock_skew": f"{skew} {drift}" if dice.chance(0.5) else skew}


def _jitter(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    """Return a rule of a machine that is a little late now and then, or overloaded all the time."""
    late = _ms(dice, 1, 10) if dice.chance(0.6) else _ms(dice, 50, 200)
    return {**({"robot": dice.pick(ids)} if dice.chance(0.5) else {}), "tick_jitter": late}


def _dropout(dice: Dice, ids: Sequence[int], trouble_s: float) -> Tables:
    rule: Tables = {"robot": dice.pick(ids), "topic": "state", "loss": _percent(dice, 1.0, 30.0)}
    return rule | _window(dice, trouble_s, trouble_s)


_RULES: Final[Mapping[str, Callable[[Dice, Sequence[int], float], Tables]]] = {
    "link": _link, "partition": _partition, "range": _range, "process": _process, "own": _own,
    "clock": _clock, "jitter": _jitter, "dropout": _dropout,
}  # fmt: skip


# --- links ------------------------------------------------------------------------------------------


def draw_late(scene: Scene) -> None:
    """Make messages between all robots, or some of them, late; some get lost."""
    dice, preset, ids = scene.dice, scene.preset, scene.ids
    rule: Tables = {}
    if dice.chance(preset.late_some):
        rule["link"] = dice.pick(("->", "<->")).join(_split(dice, ids))
    late_ms = dice.whole(*preset.delay_ms)
    jitter_ms = dice.whole(0, late_ms // 4)
    how = dice.weighted((("delay", 3.0), ("jitter", 2.0)))
    if late_ms:
        rule["delay"] = f"{late_ms}ms {jitter_ms}ms" if how == "jitter" and jitter_ms else f"{late_ms}ms"
    if dice.chance(0.8) or not late_ms:
        rule["loss"] = _percent(dice, *preset.loss)
    if dice.chance(preset.late_ends):
        rule |= {"at": 0.0, "for": dice.between(*preset.late_for_s, 1)}
    scene.late_s = (late_ms + jitter_ms) / 1e3
    scene.add_rule("late", rule)


def draw_cut(scene: Scene) -> None:
    """Cut robots off from others, one way or both, to the end or until they have met."""
    dice, preset, ids = scene.dice, scene.preset, scene.members
    a, b = map(_names, scene.groups) if scene.groups else _split(dice, ids)
    majorities = "majorities" if len(ids) > 6 else f"{a} | {b}"
    rule: Tables = dice.weighted((
        ({"partition": f"{a} | {b}"}, 3.0), ({"partition": majorities}, 1.0),
        ({"partition": f"alone {dice.pick(ids)}"}, 1.0),
        ({"link": dice.pick((f"{a}->{b}", f"{b}->{a}")), "loss": "100%"}, 4.0),
        ({"link": _some_links(scene), "loss": "100%"}, float(not scene.groups and len(ids) < 7)),
    ))  # fmt: skip
    at, lasts = dice.between(*preset.cut_s, 2), scene.meet_s + dice.between(*preset.cut_for_s, 1)
    ends = dice.chance(preset.cut_ends)
    scene.add_rule("cut", {**rule, "at": at, **({"for": round(lasts, 2)} if ends else {})})
    if scene.groups:
        scene.last_s = max(scene.last_s, at + lasts)
        one, other = dice.pick((scene.groups, scene.groups[::-1]))
        strangers = [
            f"{i}->{j}" for i in one for j in other if (min(i, j), max(i, j)) not in scene.shape.edges
        ]
        if strangers and not ends and dice.chance(0.4):
            scene.add_rule("strangers", {"link": strangers, "loss": "100%"})


def _some_links(scene: Scene) -> list[str]:
    links = [f"{i}->{j}" for i in scene.members for j in scene.members if i != j]
    return scene.dice.some(links, scene.dice.whole(1, max(1, len(links) // 2)))


# --- processes --------------------------------------------------------------------------------------


def draw_dead(scene: Scene) -> None:
    """Kill agents for good. Orders replace them, send them away, or carry their bodies off."""
    dice, preset, spares = scene.dice, scene.preset, list(scene.reserve)
    stay, removed = dice.chance(preset.dead_stay), dice.chance(_REMOVED)
    for robot in dice.some(scene.members, min(dice.whole(*preset.dead), len(scene.members) - 2)):
        role = "both" if dice.chance(preset.dead_both) else "agent"
        dies_s = dice.between(*preset.dies_s, 2)
        order_s = round(dies_s + dice.between(0.3, 8.0), 2)
        rule = scene.add_rule("process", {"robot": robot, "kill": role, "at": dies_s})
        what = dice.weighted((("replace", 4.0 if spares else 0.0), ("leave", 2.0), ("leave first", 2.0)))
        if stay or dice.chance(0.2):
            what = "stay"
        if what == "replace":
            scene.add_order({"at": order_s, "kind": "replace", "robot": robot, "by": spares.pop()})
        elif what == "leave":
            scene.add_order({"at": order_s, "kind": "leave", "robot": robot})
        elif what == "leave first":  # and die in reserve
            rule["at"] = order_s
            scene.add_order({"at": dies_s, "kind": "leave", "robot": robot})
        if removed and preset.dead_stay < 1.0 and dice.chance(0.7):
            gone_s = round(order_s + dice.between(3.0, 10.0), 2)
            scene.add_order({"at": gone_s, "kind": "remove", "robots": [robot]})
        scene.last_s = max(scene.last_s, order_s)
    if dice.chance(preset.forgotten):
        scene.last_s = round(scene.last_s + _FORGOTTEN_S, 2)


def draw_restarts(scene: Scene) -> None:
    """Have living agents and plants start again, and wrenches not come for a while, after all else."""
    dice, from_s = scene.dice, scene.last_s
    dead = {rule["robot"] for rule in scene.rules if "kill" in rule}
    kinds: tuple[tuple[str, float], ...] = (("restart", 2.0), ("soon", 2.0), ("plant", 0.7), ("wrench", 0.7))
    if from_s > _FORGOTTEN_S:
        kinds += (("late", 1.0),)
    living = [robot for robot in scene.ids if robot not in dead]
    for robot in dice.some(living, dice.whole(1, 2)):
        at, kind = round(from_s + dice.between(*scene.preset.restart_s), 2), dice.weighted(kinds)
        down_s = dice.between(*((30.0, 50.0) if kind == "late" else (0.5, 4.0)), 2)
        rule: Tables = {"robot": robot, "at": at, "restart": "agent"}
        if kind == "wrench":
            rule = {"robot": robot, "at": at, "topic": "wrench", "loss": "100%", "for": down_s}
        elif kind != "restart":
            role = "plant" if kind == "plant" else "agent"
            rule = {"robot": robot, "at": round(at - down_s, 2), "kill": role, "for": down_s}
        scene.add_rule("process", rule)


def draw_stalls(scene: Scene) -> None:
    """Have every process stall now and then, each by itself, or be late nearly all the time."""
    dice = scene.dice
    stalls: tuple[int, int] = (600, 1500)
    shares: Range = (20.0 / scene.rate_hz, 60.0 / scene.rate_hz)
    lasts = dice.between(20.0, 30.0, 1)
    if scene.timeout_periods >= _PATIENT_PERIODS and dice.chance(0.5):
        stalls, shares, lasts = (300, 900), (10.0, 40.0), dice.between(8.0, 12.0, 1)
    share = f"{dice.between(*shares):.2g}%"
    rule = {"tick_jitter": f"{_ms(dice, *stalls)} {share}", "at": 0.0, "for": lasts}
    scene.add_rule("stalls", rule)


FAULTS: Final[Mapping[str, Callable[[Scene], None]]] = {
    "late": lambda scene: None,
    "any": draw_any,
    "dead": draw_dead,
    "restarts": draw_restarts,
    "cut": draw_cut,
    "stalls": draw_stalls,
    "rolling": draw_rolling,
}
"""Features in the order in which they are drawn; formations depend on how late messages are (`draw_late`)."""
