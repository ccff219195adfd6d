"""Impairments of a link: delay, loss, duplicate, reorder, corrupt, rate, range (PURE).

Names, order of parameters and meanings are those of tc-netem(8) where it has them; each class says where it
differs. Times are in seconds where no unit is written (netem: us).

Every class reads text or a number with `parse` (ValueError says what is right), and writes itself with `str`,
which `parse` reads to the same value. Draws are pure functions of a stream and a sequence number: give each
purpose of each link a stream of its own, `random_streams.stream(seed, source, destination, topic, "loss")`,
and no draw depends on another or on the order of messages.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Self, TypeAlias, TypeVar

from handfast.agent.common.quantities import (
    bits_per_second,
    correlation,
    named,
    ratio,
    seconds,
    shown,
    split,
    take_kind,
    text,
    whole,
    within,
)
from handfast.agent.common.random_streams import normal, uniform
from handfast.agent.impairments import delay_distributions
from handfast.agent.impairments.loss_models import Chain, Loss, correlated, happens
from handfast.agent.impairments.range_model import Range

__all__ = [
    "Corrupt", "Delay", "Duplicate", "Impairment", "Loss", "Range", "Rate", "Reorder",
    "interpolate", "parse_ramp",
]  # fmt: skip

LIMIT: Final = 10_000
"""Default length of a link's queue, and the most that it delays at a time, messages."""
_DELAY_KINDS: Final = ("constant", *delay_distributions.SHAPES)
_delay = within(seconds, 0.0, 3600.0, "s")
_bitrate = within(bits_per_second, 1.0, 1e12, "bit/s")


@dataclass(frozen=True, slots=True)
class Delay:
    """The delay of a message: "200ms", "80ms 20ms 25%", "normal 80ms 20ms".

    Mean and jitter, s, and the correlation of successive delays. With a jitter and no distribution uniform,
    mean +- jitter; the others are those of `delay_distributions.SHAPES`, and netem's order "80ms 20ms
    distribution normal" is read as well. Correlation leaves the distribution as it is, and is that of delays
    before they are cut at 0.
    """

    distribution: str = "constant"  # or a name of delay_distributions.SHAPES
    mean: float = 0.0
    jitter: float = 0.0
    correlation: float = 0.0
    _score_correlation: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        of_scores = 0.0
        if self.correlation > 0.0:
            of_scores = delay_distributions.score_correlation(self.distribution, self.correlation)
        object.__setattr__(self, "_score_correlation", of_scores)

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text or a number of seconds. ValueError."""
        words = split(raw, '"200ms", "80ms 20ms" or "normal 80ms 20ms 25%"')
        kind = take_kind(words, _DELAY_KINDS)
        if len(words) >= 2 and words[-2] == "distribution":
            if kind is not None or words[-1] not in delay_distributions.SHAPES:
                known = ", ".join(delay_distributions.SHAPES)
                raise ValueError(f"must name one distribution, of {known}, got {shown(raw)}")
            kind = words[-1]
            del words[-2:]
        kind = kind or ("constant" if len(words) == 1 else "uniform")
        if kind == "constant":
            if len(words) != 1:
                raise ValueError(f'must be written "constant 80ms", got {shown(raw)}')
            return cls(kind, _delay(words[0]))
        if not 2 <= len(words) <= 3:
            form = f'"{kind} 80ms 20ms" (mean, jitter) or "{kind} 80ms 20ms 25%" (correlation)'
            raise ValueError(f"must be written {form}, got {shown(raw)}")
        jitter = named("jitter", _delay, words[1])
        return cls(kind, named("mean", _delay, words[0]), jitter, correlation(words[2:]))

    def __str__(self) -> str:
        words = [text(self.mean, "s")]
        if self.distribution != "constant":
            words.append(text(self.jitter, "s"))
            if self.distribution != "uniform":
                words.insert(0, self.distribution)
            if self.correlation:
                words.append(text(self.correlation, "ratio"))
        return " ".join(words)

    def sample(self, stream: int, sequence: int) -> float:
        """The delay of one message, s; less than 0 is cut to 0, as in netem."""
        if self.distribution == "constant":
            return self.mean
        shape = delay_distributions.SHAPES[self.distribution]
        if self._score_correlation:
            z = delay_distributions.score(stream, sequence, self._score_correlation)
        else:
            z = normal(stream, sequence)
        delay = self.mean + self.jitter * shape(z)
        return delay if delay > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class _Chance:
    """An event with a probability and a correlation of successive ones."""

    probability: float
    correlation: float = 0.0
    _chain: Chain | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_chain", correlated(self.probability, self.correlation))

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text or a ratio. ValueError."""
        words = split(raw, '"1%" or with a correlation "1% 25%"')
        if len(words) > 2:
            raise ValueError(f'must be written "1%" or with a correlation "1% 25%", got {shown(raw)}')
        return cls(ratio(words[0]), correlation(words[1:]))

    def __str__(self) -> str:
        chance = text(self.probability, "ratio")
        return f"{chance} {text(self.correlation, 'ratio')}" if self.correlation else chance

    def happens(self, stream: int, sequence: int) -> bool:
        """Whether it happens to a message."""
        return happens(stream, sequence, self.probability, self._chain)


@dataclass(frozen=True, slots=True)
class Duplicate(_Chance):
    """Which messages come twice: "1%", or with the correlation of successive ones "1% 25%"."""


@dataclass(frozen=True, slots=True)
class Corrupt(_Chance):
    """Which messages have one bit flipped: "0.1%", or with the correlation of successive ones "0.1% 25%"."""

    def bit(self, stream: int, sequence: int, size_bytes: int) -> int:
        """The bit that is flipped, 0 .. 8 size_bytes - 1 counted from the first byte; -1 for none."""
        if size_bytes > 0 and self.happens(stream, sequence):
            return int(uniform(stream, 4 * sequence + 3) * (8 * size_bytes))
        return -1


@dataclass(frozen=True, slots=True)
class Reorder(_Chance):
    """Which messages go at once while the others wait their delay: "25%", "25% 50%", "25% gap 5", "gap 5".

    A probability, the correlation of successive candidates, and a gap: only every gap-th message is a
    candidate, by its sequence number (netem counts from the last one that went at once). "gap 5" alone takes
    all of them.
    """

    gap: int = 1

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text or a ratio. ValueError."""
        form = '"25%", "25% 50%" (correlation), "25% 50% gap 5" or "gap 5"'
        words = split(raw, form)
        gap = 1
        if len(words) >= 2 and words[-2] == "gap":
            gap = whole("gap", words[-1], 1, 10**6)
            words = words[:-2] or ["100%"]
        if len(words) > 2:
            raise ValueError(f"must be written {form}, got {shown(raw)}")
        return cls(ratio(words[0]), correlation(words[1:]), gap)

    def __str__(self) -> str:
        chance = _Chance.__str__(self)
        return chance if self.gap == 1 else f"{chance} gap {self.gap}"

    def happens(self, stream: int, sequence: int) -> bool:
        """Whether a message goes at once."""
        candidate, rest = divmod(sequence + 1, self.gap)
        return rest == 0 and happens(stream, candidate, self.probability, self._chain)


@dataclass(frozen=True, slots=True)
class Rate:
    """The bandwidth of a link, which carries one message after another: "100kbit", "10kbps" (tc's units).

    "100kbit limit 50": at most 50 messages wait for it, `LIMIT` where none is given; further ones are lost.
    """

    bits_per_second: float
    limit: int = LIMIT

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text or a number of bit/s. ValueError."""
        form = '"100kbit" or "100kbit limit 50"'
        words = split(raw, form)
        if len(words) == 1:
            return cls(_bitrate(words[0]))
        if len(words) != 3 or words[1] != "limit":
            raise ValueError(f"must be written {form}, got {shown(raw)}")
        return cls(_bitrate(words[0]), whole("limit", words[2], 1, 10**6))

    def __str__(self) -> str:
        more = f" limit {self.limit}" if self.limit != LIMIT else ""
        return text(self.bits_per_second, "bit/s") + more

    def transmission_s(self, size_bytes: int) -> float:
        """How long the link is busy with a message, s."""
        return 8.0 * size_bytes / self.bits_per_second


# --- ramps ------------------------------------------------------------------------------------

Impairment: TypeAlias = Delay | Loss | Duplicate | Corrupt | Reorder | Rate | Range
T = TypeVar("T", Delay, Loss, Duplicate, Corrupt, Reorder, Rate, Range)


def interpolate(a: T, b: T, fraction: float) -> T:
    """Between `a` (fraction 0) and `b` (1), every number linearly; ValueError when they differ in more.

    Kinds, names and whole numbers (every, gap, retries) must agree.
    """
    changes: dict[str, Any] = {}
    for item in fields(a):
        one, other = getattr(a, item.name), getattr(b, item.name)
        if not item.init or one == other:
            continue
        if isinstance(one, float) and isinstance(other, float):
            changes[item.name] = _between(one, other, fraction)
        elif isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other):
            changes[item.name] = tuple(_between(x, y, fraction) for x, y in zip(one, other, strict=True))
        else:
            raise ValueError(
                "must have ends of one kind that differ in numbers alone, such as "
                f'"normal 0ms 0ms .. normal 80ms 20ms", got {shown(str(a))} and {shown(str(b))}'
            )
    return replace(a, **changes) if changes else a


def _between(a: float, b: float, fraction: float) -> float:
    return (1.0 - fraction) * a + fraction * b


def parse_ramp(cls: type[T], raw: object) -> tuple[T, T] | T:
    """A value of a class, or both ends of a ramp written "0%..50%". ValueError."""
    if not isinstance(raw, str) or ".." not in raw:
        return cls.parse(raw)
    first, _, last = raw.partition("..")
    start, end = cls.parse(first), cls.parse(last)
    interpolate(start, end, 0.5)
    return start, end
