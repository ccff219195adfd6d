"""Faults as a fleet file gives them: ``[faults]`` and its ``[[faults.rule]]`` (PURE).

A rule says where (`link`, `robot`, `topic`, `partition`), when (`at`, `for`, `every`, `until`) and what. Only
the words are read here; `agent.links.fault_plan` finds which rule holds at a moment,
`agent.links.link_emulator` what it does to a message. The same tables in a file of their own are a scenario,
and sent to a running fleet they are live faults.
"""

# ruff: noqa: RUF009 (setting() is dataclasses.field)
from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Generic, Literal, TypeVar, cast

from handfast.agent.common.settings import about, setting
from handfast.agent.fleet.fault_targets import LinkSet, Partition
from handfast.agent.impairments.impairments import (
    Corrupt,
    Delay,
    Duplicate,
    Impairment,
    Loss,
    Range,
    Rate,
    Reorder,
    Slot,
    interpolate,
    parse_ramp,
)

T = TypeVar("T", bound=Impairment)

Process = Literal["agent", "plant", "both"]
LIMIT: Final = 10_000
"""Messages that may wait on one link where a rule gives no `limit`."""
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
        "`normal 80ms 20ms 25%` (distribution, mean, jitter, correlation; also `pareto`, `paretonormal`), "
        "`trace NAME`.",
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
        Rate, '"100kbit"', "What the link carries; messages queue for it. Units are those of tc."
    )
    limit: int | None = setting(
        None,
        f"Messages that may wait on one link, {LIMIT} where not given; further ones are lost.",
        ge=1,
        le=1_000_000,
        example="1000",
    )
    slot: Effect[Slot] | None = _impairment(
        Slot, '"100ms"', "Messages come in bursts, one every so often; `50ms 150ms`: least and most."
    )
    hold: bool | None = setting(None, "Messages wait until the fault ends, and then come all at once.")
    range: Effect[Range] | None = _impairment(
        Range,
        '"disc 10m"',
        "Loss and delay by the distance of the two robots: `disc 10m`, or `logdistance 10m exponent 2.7 "
        "shadowing 4dB retries 3 5ms`.",
    )


EFFECTS: Final = (
    "delay", "loss", "duplicate", "reorder", "corrupt", "rate", "limit", "slot", "hold", "range",
)  # fmt: skip
"""Fields of a rule that are about links."""
SENSOR_FIELDS: Final = ("position_bias_m", "heading_bias_rad", "jump_m")
"""Fields of a rule that are about measurements."""
ACTION_FIELDS: Final = ("kill", "pause", "restart")
CLOCK_FIELDS: Final = ("clock_skew", "clock_drift")
PROCESS_FIELDS: Final = (*ACTION_FIELDS, *CLOCK_FIELDS, "tick_jitter", "tick_jitter_share")
"""Fields of a rule that are about processes and their clocks."""


def _bias(what: str, unit: str, limit: float = 100.0) -> Any:
    return setting(None, f"Added to the measured {what}.", unit=unit, ge=-limit, le=limit)


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
    tick_jitter: float | None = setting(
        None, "Ticks of agent and plant come late by up to this.", unit="s", ge=0, le=2, example='"5ms"'
    )
    tick_jitter_share: float | None = setting(
        None,
        "So many of them do, each process's by itself, as on a machine that has too much to do; all where "
        "not given.",
        unit="ratio",
        ge=0,
        le=1,
        example='"5%"',
    )
    clock_skew: float | None = setting(
        None,
        "The robot's clock is ahead by this, for the whole run.",
        unit="s",
        ge=-3600,
        le=3600,
        example='"100ms"',
    )
    clock_drift: float | None = setting(
        None,
        "The robot's clock is faster by this share, for the whole run.",
        unit="ratio",
        ge=-0.01,
        le=0.01,
        example='"50ppm"',
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
class Trace:
    """One ``[[faults.trace]]``."""

    name: str = field(
        metadata=about(
            'What `delay = "trace NAME"` calls it.', pattern=r"[A-Za-z0-9_-]{1,40}",
            pattern_says="1 to 40 letters, digits, - or _", example='"wifi"',
        )
    )  # fmt: skip
    delays: tuple[float, ...] = setting(
        (),
        "Delays one after the other, used in turn and again from the first; -1 is a message that is lost.",
        unit="s",
        ge=-1,
        le=3600,
        example="[0.012, 0.019, -1]",
    )


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
    traces: tuple[Trace, ...] = setting((), 'Recorded delays, for `delay = "trace NAME"`.', key="trace")
