"""Fault rules of a fleet file: ``[faults]``, ``[[faults.rule]]`` and the sets of links they apply to (PURE).

A rule says where (`link`, `robot`, `topic`, `partition`), when (`at`, `for`, `every`, `until`) and what. This
module only reads the tables. `agent.links.fault_plan` finds the rule in force at a given time, and
`agent.links.link_emulator` applies it to a message. A scenario file holds the same tables, and operators send
them to a running fleet as live faults.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, Literal, TypeAlias, TypeVar, cast

from handfast.agent.common.quantities import quantity, ratio, seconds, split, text, within
from handfast.agent.common.settings import setting
from handfast.agent.common.wording import show
from handfast.agent.impairments.impairments import (
    LIMIT,
    Corrupt,
    Delay,
    Duplicate,
    Impairment,
    Loss,
    Range,
    Rate,
    Reorder,
    interpolate,
    parse_ramp,
)

_IDS = r"\*|[0-9]{1,4}(?:\s*,\s*[0-9]{1,4})*"
_LINK = re.compile(rf"\s*({_IDS})\s*(<->|->)\s*({_IDS})\s*")


@dataclass(frozen=True, slots=True)
class LinkSet:
    """A set of directed links: pairs of (sources, destinations), None standing for every robot."""

    pairs: tuple[tuple[tuple[int, ...] | None, tuple[int, ...] | None], ...]

    @classmethod
    def parse(cls, raw: object) -> LinkSet:
        """``"1->2"``, ``"1<->2"``, ``"1,2->3"``, ``"*->3"``; several in an array, or with ``;`` between them.

        Raises:
            ValueError: anything else, with the text that is wrong.
        """
        texts = raw.split(";") if isinstance(raw, str) else raw
        if not isinstance(texts, (list, tuple)) or not texts:
            raise ValueError(f'must be a link such as "1->2", "1<->2", "1,2->3" or "*->3", got {show(raw)}')
        pairs: list[tuple[tuple[int, ...] | None, tuple[int, ...] | None]] = []
        for each in texts:
            match = _LINK.fullmatch(each) if isinstance(each, str) and len(each) < 2000 else None
            if match is None:
                raise ValueError(
                    f'must be a link such as "1->2", "1<->2", "1,2->3" or "*->3", got {show(each)}'
                )
            left, right = _ids(match[1]), _ids(match[3])
            pairs.append((left, right))
            if match[2] == "<->":
                pairs.append((right, left))
        return cls(tuple(pairs))

    def __str__(self) -> str:
        shown = ("*" if ids is None else ",".join(map(str, ids)) for pair in self.pairs for ids in pair)
        return "; ".join(f"{source}->{destination}" for source, destination in zip(shown, shown, strict=True))

    @property
    def ends(self) -> tuple[int, int] | None:
        """Source and destination when it is one link, else None."""
        if len(self.pairs) == 1 and all(ids is not None and len(ids) == 1 for ids in self.pairs[0]):
            (source, destination), *_ = self.pairs
            return (source or (0,))[0], (destination or (0,))[0]
        return None

    def named(self) -> set[int]:
        """Every robot that is named."""
        return {robot for pair in self.pairs for ids in pair if ids is not None for robot in ids}

    def has(self, source: int, destination: int) -> bool:
        """Whether the link from `source` to `destination` is one of them."""
        return any(
            (sources is None or source in sources) and (destinations is None or destination in destinations)
            for sources, destinations in self.pairs
        )


def _ids(text: str) -> tuple[int, ...] | None:
    return None if text == "*" else tuple(sorted({int(part) for part in text.split(",")}))


@dataclass(frozen=True, slots=True)
class Partition:
    """Who hears whom no more: ``groups`` apart, one robot ``alone``, a ``bridge``, ring of ``majorities``.

    The kinds are those of Jepsen's nemeses (Kingsbury). `groups` holds the groups, or the robot that is
    alone or the bridge.
    """

    kind: Literal["groups", "alone", "bridge", "majorities"]
    groups: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def parse(cls, raw: object) -> Partition:
        """``"1,2,3 | 4,5,6"``, ``"alone 4"``, ``"bridge 3"`` or ``"majorities"``.

        Raises:
            ValueError: anything else.
        """
        wrong = (
            'must be groups such as "1,2,3 | 4,5,6", "alone 4", "bridge 3" or "majorities", '
            f"got {show(raw)} (one way only: write a link such as \"1,2->3,4\" with loss = '100%')"
        )
        if not isinstance(raw, str) or len(raw) > 4000:
            raise ValueError(wrong)
        words = raw.split()
        if words == ["majorities"]:
            return cls("majorities")
        if len(words) == 2 and words[0] in ("alone", "bridge") and re.fullmatch(r"[0-9]{1,4}", words[1]):
            return cls(cast(Literal["alone", "bridge"], words[0]), ((int(words[1]),),))
        groups = []
        for part in raw.split("|"):
            if not re.fullmatch(r"\s*[0-9]{1,4}(\s*,\s*[0-9]{1,4})*\s*", part):
                raise ValueError(wrong)
            groups.append(tuple(sorted({int(text) for text in part.split(",")})))
        if len(groups) < 2:
            raise ValueError(wrong)
        flat = [robot for group in groups for robot in group]
        twice = sorted({robot for robot in flat if flat.count(robot) > 1})
        if twice:
            raise ValueError(
                f"robot {twice[0]} is in two groups of {show(raw)}: groups must not share robots"
            )
        return cls("groups", tuple(groups))

    def __str__(self) -> str:
        if self.kind == "groups":
            return " | ".join(",".join(map(str, group)) for group in self.groups)
        return self.kind if not self.groups else f"{self.kind} {self.groups[0][0]}"

    def named(self) -> set[int]:
        """Every robot that is named."""
        return {robot for group in self.groups for robot in group}

    def cuts(self, source: int, destination: int, ids: Sequence[int]) -> bool:
        """Whether `destination` does not hear `source`; `ids` are the fleet's, from which halves are made."""
        if self.kind == "groups":
            group = {robot: number for number, members in enumerate(self.groups) for robot in members}
            return source in group and destination in group and group[source] != group[destination]
        if self.kind == "alone":
            return (source in self.groups[0]) != (destination in self.groups[0])
        ring = sorted(ids)
        if self.kind == "bridge":
            rest = [robot for robot in ring if robot not in self.groups[0]]
            if source not in rest or destination not in rest:
                return False
            half = (len(rest) + 1) // 2
            return (rest.index(source) < half) != (rest.index(destination) < half)
        # Each robot hears the majority that lies around it on the ring of ids: no two hear the same one.
        count, others = len(ring), len(ring) // 2
        away = (ring.index(source) - ring.index(destination)) % count
        return not (away <= (others + 1) // 2 or away >= count - others // 2)


# ruff: noqa: RUF009 (setting() is dataclasses.field)


T = TypeVar("T", bound=Impairment)

Process = Literal["agent", "plant", "both"]
_FAR: Final = 1e6
_TICK: Final = 1e-3  # no fleet ticks faster


@dataclass(frozen=True, slots=True)
class Effect(Generic[T]):
    """A setting of a rule: `start` all the time, or a ramp from `start` to `end` over the rule's ``for``."""

    start: T
    end: T | None = None

    def at(self, fraction: float) -> T:
        """The setting when `fraction` (0..1) of the rule's time has passed."""
        if self.end is None:
            return self.start
        start: Any = self.start
        return cast(T, interpolate(start, self.end, fraction))

    def __str__(self) -> str:
        return str(self.start) if self.end is None else f"{self.start} .. {self.end}"


def _effect(kind: Any, raw: object) -> Effect[Any]:
    parsed = parse_ramp(kind, raw)
    return Effect(*parsed) if isinstance(parsed, tuple) else Effect(parsed)


def _effect_of(kind: type) -> Callable[[object], Effect[Any]]:
    return partial(_effect, kind)


def _parsed(model: Any, example: str, doc: str, **rest: Any) -> Any:
    return setting(None, doc, parse=model.parse, example=example, **rest)


def _impairment(kind: type, example: str, doc: str) -> Any:
    return setting(None, doc, parse=_effect_of(kind), example=example)


@dataclass(frozen=True, slots=True)
class Impairments:
    """What a link does to messages; names and meanings are netem's where it has them."""

    delay: Effect[Delay] | None = _impairment(
        Delay,
        '"200ms"',
        "Messages come this much after they were sent: `200ms`, `80ms 20ms` (uniform, +- 20 ms), "
        "`normal 80ms 20ms 25%` (distribution, mean, jitter, correlation; also `pareto`, `paretonormal`).",
    )
    loss: Effect[Loss] | None = _impairment(
        Loss,
        '"30%"',
        "Messages that are lost: `30%`, `30% 25%` (correlation), `gemodel 1% 10% 70% 0.1%` "
        "(Gilbert-Elliott), `state 1% 10%` (4-state Markov), `every 3`.",
    )
    duplicate: Effect[Duplicate] | None = _impairment(
        Duplicate, '"1%"', "Messages that come twice; `1% 25%`: with correlation."
    )
    reorder: Effect[Reorder] | None = _impairment(
        Reorder,
        '"25% 50% gap 5"',
        "Messages that overtake: sent at once while the others wait their `delay` (probability, correlation, "
        "gap).",
    )
    corrupt: Effect[Corrupt] | None = _impairment(
        Corrupt, '"0.1%"', "Messages in which one bit is flipped; the receiver finds and drops them."
    )
    rate: Effect[Rate] | None = _impairment(
        Rate,
        '"100kbit"',
        "What the link carries, in units of tc; messages queue for it. `100kbit limit 50`: at most 50 wait, "
        f"further ones are lost ({LIMIT} where not given).",
    )
    range: Effect[Range] | None = _impairment(
        Range,
        '"disc 10m"',
        "Loss and delay by the distance of the two robots: `disc 10m`, or `logdistance 10m exponent 2.7 "
        "shadowing 4dB retries 3 5ms`.",
    )


EFFECTS: Final = (
    "delay", "loss", "duplicate", "reorder", "corrupt", "rate", "range",
)  # fmt: skip
"""Fields of a rule that are about links."""
SENSOR_FIELDS: Final = ("position_bias_m", "heading_bias_rad", "jump_m")
"""Fields of a rule that are about measurements."""
ACTION_FIELDS: Final = ("kill", "pause", "restart")
CLOCK_FIELDS: Final = ("clock_skew",)
PROCESS_FIELDS: Final = (*ACTION_FIELDS, *CLOCK_FIELDS, "tick_jitter")
"""Fields of a rule that are about processes and their clocks."""


def _bias(what: str, unit: str, limit: float = 100.0) -> Any:
    return setting(None, f"Added to the measured {what}.", unit=unit, ge=-limit, le=limit)


_Read: TypeAlias = Callable[[object], float]
_late = within(seconds, 0.0, 2.0, "s")
_ahead = within(seconds, -3600.0, 3600.0, "s")
_drift = within(partial(quantity, unit="ratio"), -0.01, 0.01, "")


@dataclass(frozen=True, slots=True)
class TickJitter:
    """Lateness of ticks, "5ms" or "500ms 5%": at most `most_s`, in this share of the ticks."""

    most_s: float
    share: float = 1.0

    @classmethod
    def parse(cls, raw: object) -> TickJitter:
        """From text or a number of seconds. ValueError."""
        return cls(*_time_and_ratio(raw, _late, ratio, '"5ms" or "500ms 5%" (5 % of ticks)'))

    def __str__(self) -> str:
        return text(self.most_s, "s") + (f" {text(self.share, 'ratio')}" if self.share < 1.0 else "")


@dataclass(frozen=True, slots=True)
class ClockError:
    """Error of a clock, "100ms" or "100ms 50ppm": offset `ahead_s` and relative rate error `drift`."""

    ahead_s: float
    drift: float = 0.0

    @classmethod
    def parse(cls, raw: object) -> ClockError:
        """From text or a number of seconds. ValueError."""
        return cls(*_time_and_ratio(raw, _ahead, _drift, '"100ms" or "100ms 50ppm" (drift)'))

    def __str__(self) -> str:
        return text(self.ahead_s, "s") + (f" {text(self.drift, 'ratio')}" if self.drift else "")


def _time_and_ratio(raw: object, time: _Read, ratio: _Read, form: str) -> list[float]:
    """Read a time (s) and, where one follows it, a ratio. ValueError names `form`."""
    words = split(raw, form)
    if len(words) > 2:
        raise ValueError(f"must be written {form}, got {show(raw)}")
    return [read(word) for read, word in zip((time, ratio), words, strict=False)]


@dataclass(frozen=True, slots=True)
class Rule(Impairments):
    """One ``[[faults.rule]]``."""

    name: str = setting("", "What reports call it; `rule 1`, `rule 2`, ... where not given.", example='"cut"')
    link: LinkSet | None = _parsed(
        LinkSet,
        '"1->2"',
        "Links that it is for: `1->2`, `1<->2` both ways, `1,2->3`, `*->3`; or an array.",
    )
    robot: tuple[int, ...] | int | None = setting(
        None,
        "Robots that it is for; an effect on links: all to and from them.",
        ge=1,
        le=9999,
        example="3",
    )
    topic: Literal["hand", "state", "wrench", "all"] = setting(
        "hand",
        "Messages that it is for: `hand` between agents (hand states and beacons), `state` from a plant to "
        "its agent (the sensor), `wrench` from an agent to its plant (the command).",
    )
    partition: Partition | None = _parsed(
        Partition,
        '"1,2,3 | 4,5,6"',
        "Groups that do not hear each other, `alone 4`, `bridge 3` or `majorities`. Cut links lose all "
        "messages, or suffer the effects that the rule gives.",
    )
    at: float | None = setting(
        None,
        "When it begins, in time of the run; left out: from before the start (`0` when it has a `for`).",
        unit="s",
        ge=0,
        le=_FAR,
        example='"5s"',
    )
    duration: float | None = setting(
        None,
        "How long it lasts; left out: to the end.",
        key="for",
        unit="s",
        ge=_TICK,
        le=_FAR,
        example='"10s"',
    )
    every: float | None = setting(
        None,
        "It comes again after so long, each time for `for`.",
        unit="s",
        ge=_TICK,
        le=_FAR,
        example='"1s"',
    )
    until: float | None = setting(
        None, "The end of an `every`, in time of the run.", unit="s", gt=0, le=_FAR, example='"20s"'
    )
    position_bias_m: tuple[float, float] | None = _bias("position (east, north)", "m", 1e4)
    heading_bias_rad: float | None = _bias("heading", "rad", math.pi)
    jump_m: float | None = setting(
        None,
        "One measured position in a hundred is off by this in some direction.",
        unit="m",
        ge=0,
        le=1e4,
        example="0.5",
    )
    kill: Process | None = setting(
        None, "Kills the robot's process; it is started again after `for`, or never.", example='"agent"'
    )
    pause: Process | None = setting(None, "Freezes the process (SIGSTOP) for `for`.", example='"plant"')
    restart: Process | None = setting(None, "Kills the process and starts it again.", example='"agent"')
    wipe: bool | None = setting(
        None, "`kill`, `restart`: its disk is lost with it; it starts again without any order that it kept."
    )
    tick_jitter: TickJitter | None = _parsed(
        TickJitter,
        '"5ms"',
        "Ticks of agent and plant come late by up to this; `500ms 5%`: 5 % of them, as on a machine that is "
        "overloaded.",
    )
    clock_skew: ClockError | None = _parsed(
        ClockError,
        '"100ms"',
        "The robot's clock is ahead by this for the whole run; `100ms 50ppm`: and gains 50 us a second.",
    )

    def given(self, names: Sequence[str]) -> list[str]:
        """Those of the fields `names` that the rule gives."""
        return [name for name in names if getattr(self, name) is not None]

    @property
    def robots(self) -> tuple[int, ...] | None:
        """The robots of `robot`, None for every one."""
        return (self.robot,) if isinstance(self.robot, int) else self.robot

    def windows(self, end: float) -> Iterator[tuple[float, float]]:
        """(start, end) of each time it holds, s of fleet time, cut at `end`."""
        start = self.at or 0.0
        last = min(end, math.inf if self.until is None else self.until)
        while start < last:
            yield start, last if self.duration is None else min(start + self.duration, last)
            if self.every is None:
                return
            start += self.every


@dataclass(frozen=True, slots=True)
class FaultsSection(Impairments):
    """``[faults]``: faults of all links between agents, and of some at times."""

    seed: int | None = setting(
        None, "Seed of the links' draws; that of `[fleet]` where not given.", ge=0, le=2**63 - 1, example="0"
    )
    rules: tuple[Rule, ...] = setting(
        (),
        "Faults at some places or times. A rule says where (`link`, `robot`, `topic` or `partition`), when "
        "(`at`, `for`, `every`, `until`) and what: any effect of `[faults]` above, or one of these. A ramp "
        'is written with two dots: `loss = "0%..50%"` grows over the `for`.',
        key="rule",
    )
