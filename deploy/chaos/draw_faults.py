"""Random faults: of links, of processes, of clocks, of sensors (PURE). Times in s of the drive."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from deploy.chaos.dice import Dice, Tables
from deploy.chaos.draw_obstacles import Reach

_COUNTS: Final = ((0, 1.0), (1, 2.0), (2, 3.0), (3, 3.0), (4, 2.0), (6, 1.0), (8, 0.5))
_KINDS: Final = (
    ("link", 6.0), ("partition", 3.0), ("range", 1.0), ("process", 6.0), ("own", 1.5), ("clock", 1.5),
    ("jitter", 1.0), ("dropout", 0.7),
)  # fmt: skip
PAUSE_MAX_S: Final = 3.0
DOWN_MAX_S: Final = 6.0
CUT_MAX_S: Final = 6.0
SKEW_MAX_S: Final = 0.03
DRIFT_MAX: Final = 1e-4
_BEGIN_S: Final = 0.5
"""Least time before the trouble ends at which a fault begins."""


def draw_faults(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> list[Tables]:
    """``[[faults.rule]]`` of a scenario: over at `trouble_s`, but for mild ones that last."""
    rules: list[Tables] = []
    for number in range(1, dice.weighted(_COUNTS) + 1):
        kind = dice.weighted(_KINDS)
        rule = _RULES[kind](dice, ids, trouble_s, reach)
        rules.append({"name": f"{kind} {number}", **rule})
    return rules


def _ms(low: float, high: float, dice: Dice) -> str:
    return f"{dice.whole(round(1e3 * low), round(1e3 * high))}ms"


def _percent(dice: Dice, low: float, high: float) -> str:
    return f"{dice.between(low, high, 1):g}%"


def _window(dice: Dice, trouble_s: float, longest_s: float, least_s: float = 0.2) -> Tables:
    at = dice.between(0.0, trouble_s - _BEGIN_S, 2)
    lasts = min(dice.between(least_s, longest_s, 2), round(trouble_s - at, 2))
    return {"at": at, "for": lasts}


def _flapping(dice: Dice, trouble_s: float) -> Tables:
    """The fields of a rule that comes and goes until the trouble ends."""
    at, lasts = dice.between(0.0, trouble_s - _BEGIN_S, 2), dice.between(0.2, 1.2, 2)
    return {"at": at, "for": lasts, "every": round(lasts + dice.between(0.2, 2.0), 2), "until": trouble_s}


def _place(dice: Dice, ids: Sequence[int]) -> Tables:
    """The fields of a rule that name its links; none: all links."""
    where = dice.weighted((("all", 3.0), ("robot", 2.0), ("one", 2.0), ("from", 1.0), ("to", 1.0)))
    if where == "robot":
        return {"robot": dice.pick(ids)}
    if where == "from":
        return {"link": f"{dice.pick(ids)}->*"}
    if where == "to":
        return {"link": f"*->{dice.pick(ids)}"}
    if where == "one" and len(ids) > 1:
        a, b = dice.some(ids, 2)
        return {"link": f"{a}{dice.pick(('->', '<->'))}{b}"}
    return {}


def _link(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    """One or two effects on links between agents."""
    rule = _place(dice, ids)
    if dice.chance(0.7):
        rule |= _window(dice, trouble_s, trouble_s) if dice.chance(0.7) else _flapping(dice, trouble_s)
    for _ in range(1 if dice.chance(0.6) else 2):
        rule |= _effect(dice, windowed="for" in rule)
    return rule


def _effect(dice: Dice, *, windowed: bool) -> Tables:
    kind = dice.weighted(
        (("delay", 4.0), ("loss", 4.0), ("duplicate", 1.0), ("reorder", 1.0), ("corrupt", 1.0), ("slot", 0.5))
    )
    if kind == "delay":
        mean, jitter = dice.whole(10, 300), dice.whole(1, 100)
        jitter = min(jitter, mean)
        form = dice.pick(("{m}ms", "{m}ms {j}ms", "normal {m}ms {j}ms", "pareto {m}ms {j}ms 25%"))
        return {"delay": form.format(m=mean, j=jitter)}
    if kind == "loss":
        if windowed and dice.chance(0.15):
            return {"loss": "100%"}
        form = dice.pick(("{p}", "{p} 25%", "gemodel 5% 20%", "state 2% 10%", "every 3"))
        return {"loss": form.format(p=_percent(dice, 1.0, 40.0))}
    if kind == "duplicate":
        return {"duplicate": _percent(dice, 1.0, 40.0)}
    if kind == "reorder":
        return {"reorder": _percent(dice, 5.0, 40.0), "delay": _ms(0.02, 0.2, dice)}
    if kind == "corrupt":
        return {"corrupt": _percent(dice, 0.1, 5.0)}
    return {"slot": _ms(0.05, 0.3, dice)}


def _partition(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    kinds = ["alone"]
    if len(ids) >= 3:
        kinds += ["groups", "groups", "bridge"]
    if len(ids) >= 5:
        kinds.append("majorities")
    kind = dice.pick(kinds)
    if kind == "groups":
        first = dice.some(ids, dice.whole(1, len(ids) - 1))
        groups = [first, [robot for robot in ids if robot not in first]]
        text = " | ".join(",".join(map(str, group)) for group in groups)
    else:
        text = kind if kind == "majorities" else f"{kind} {dice.pick(ids)}"
    window = _window(dice, trouble_s, CUT_MAX_S) if dice.chance(0.7) else _flapping(dice, trouble_s)
    return {"partition": text, **window}


def _range(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    """Links of limited range."""
    metres = dice.between(3.0, 8.0, 1)
    form = dice.pick(("disc {m}m", "logdistance {m}m exponent 2.7 shadowing 3dB"))
    return {"range": form.format(m=metres), **_window(dice, trouble_s, CUT_MAX_S)}


def _process(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    """A process that is killed, for a while or for good, started again, or paused."""
    role = dice.weighted((("agent", 4.0), ("plant", 2.0), ("both", 1.0)))
    robot = dice.pick(ids)
    what = dice.weighted((("kill", 3.0), ("pause", 3.0), ("restart", 2.0), ("for good", 0.3)))
    if what == "restart":
        return {"robot": robot, "restart": role, "at": dice.between(0.0, trouble_s, 2)}
    if what == "for good":
        return {"robot": robot, "kill": role, "at": dice.between(0.0, trouble_s, 2)}
    longest = PAUSE_MAX_S if what == "pause" else DOWN_MAX_S
    return {"robot": robot, what: role, **_window(dice, trouble_s, longest, 0.1)}


def _own(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    """Between a robot's agent and its plant."""
    rule: Tables = {"robot": dice.pick(ids), "topic": dice.pick(("state", "wrench"))}
    rule |= {"delay": _ms(0.005, 0.04, dice)} if dice.chance(0.5) else {"loss": _percent(dice, 1.0, 20.0)}
    return rule | _window(dice, trouble_s, trouble_s)


def _clock(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    rule: Tables = {"robot": dice.pick(ids), "clock_skew": dice.between(-SKEW_MAX_S, SKEW_MAX_S, 4)}
    if dice.chance(0.5):
        rule["clock_drift"] = dice.between(-DRIFT_MAX, DRIFT_MAX, 6)
    return rule


def _jitter(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    # A machine that has now and then a little too much to do, or all the time more than it can.
    late = _ms(0.001, 0.01, dice) if dice.chance(0.6) else _ms(0.05, 0.2, dice)
    return {**({"robot": dice.pick(ids)} if dice.chance(0.5) else {}), "tick_jitter": late}


def _dropout(dice: Dice, ids: Sequence[int], trouble_s: float, reach: Reach) -> Tables:
    return {
        "robot": dice.pick(ids),
        "dropout": _percent(dice, 1.0, 30.0),
        **_window(dice, trouble_s, trouble_s),
    }


_RULES: Final = {
    "link": _link,
    "partition": _partition,
    "range": _range,
    "process": _process,
    "own": _own,
    "clock": _clock,
    "jitter": _jitter,
    "dropout": _dropout,
}
