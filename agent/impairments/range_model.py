"""Loss and delay of a message by the distance between two robots (PURE)."""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, log10, sqrt
from typing import Any, Final, Self

from handfast.agent.common.quantities import (
    decibels,
    metres,
    metres_per_second,
    named,
    seconds,
    shown,
    split,
    take_kind,
    text,
    whole,
    within,
)
from handfast.agent.common.random_streams import uniform

_RETRIES_MAX: Final = 15
_OPTIONS: Final = {
    "disc": {"speed": 1},
    "logdistance": {"exponent": 1, "shadowing": 1, "retries": 2, "speed": 1},
}
"""Of each kind: how many words follow each option."""
_FORM = (
    '"disc 10m", or "logdistance 10m" with any of "exponent 2.7", "shadowing 4dB", "retries 3 5ms"; '
    'both with "speed 1500m/s" if wanted'
)
_distance = within(metres, 1e-3, 1e6, "m")
_shadowing = within(decibels, 0.1, 100.0, "dB")
_retry = within(seconds, 0.0, 60.0, "s")
_speed = within(metres_per_second, 1.0, 3e8, "m/s")


def _exponent(raw: object) -> float:
    try:
        value = float(str(raw))
    except ValueError:
        value = 0.0
    if not 1.0 <= value <= 10.0:
        raise ValueError(f"must be a number between 1 and 10, got {shown(raw)}")
    return value


@dataclass(frozen=True, slots=True)
class Range:
    """Loss and delay by the distance d between the robots: "disc 10m", "logdistance 10m exponent 2.7 ...".

    - disc: everything is lost beyond the distance.
    - logdistance: path loss with exponent n (2 in free space) and log-normal shadowing of sigma dB (Rappaport
      2002, Wireless Communications, 4.9). At the distance given half of the tries fail, at d
      Phi(10 n log10(d / distance) / sigma) of them, each try by a draw of its own. A message has up to
      retries + 1 tries; each failed one costs its time, and the message is lost when all fail.
    - speed: of the signal, such as 1500 m/s of sound in water; d / speed is added to the delay.
    """

    kind: str
    distance_m: float
    exponent: float = 2.7
    shadowing_db: float = 4.0
    retries: int = 0
    retry_s: float = 0.0
    speed_mps: float | None = None

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text. ValueError."""
        wrong = f"must be written {_FORM}, got {shown(raw)}"
        words = split(raw, '"disc 10m" or "logdistance 10m"')
        kind = take_kind(words, tuple(_OPTIONS))
        if kind is None or not words:
            raise ValueError(wrong)
        distance = named("distance", _distance, words.pop(0))
        given: dict[str, list[str]] = {}
        while words:
            name = words.pop(0)
            count = _OPTIONS[kind].get(name, 0)
            if not count or name in given or len(words) < count:
                raise ValueError(wrong)
            given[name], words = words[:count], words[count:]
        options: dict[str, Any] = {}
        if "exponent" in given:
            options["exponent"] = named("exponent", _exponent, given["exponent"][0])
        if "shadowing" in given:
            options["shadowing_db"] = named("shadowing", _shadowing, given["shadowing"][0])
        if "retries" in given:
            options["retries"] = whole("retries", given["retries"][0], 0, _RETRIES_MAX)
            options["retry_s"] = named("time of a retry", _retry, given["retries"][1])
        if "speed" in given:
            options["speed_mps"] = named("speed", _speed, given["speed"][0])
        return cls(kind, distance, **options)

    def __str__(self) -> str:
        parts = [f"{self.kind} {text(self.distance_m, 'm')}"]
        if self.kind == "logdistance":
            parts.append(f"exponent {self.exponent!r} shadowing {text(self.shadowing_db, 'dB')}")
            if self.retries or self.retry_s:
                parts.append(f"retries {self.retries} {text(self.retry_s, 's')}")
        if self.speed_mps is not None:
            parts.append(f"speed {text(self.speed_mps, 'm/s')}")
        return " ".join(parts)

    def failure(self, distance_m: float) -> float:
        """The probability that one try fails at a distance."""
        if self.kind == "disc":
            return float(distance_m > self.distance_m)
        if distance_m <= 0.0:
            return 0.0
        margin = 10.0 * self.exponent * log10(distance_m / self.distance_m) / self.shadowing_db
        return 0.5 * erfc(-margin * sqrt(0.5))

    def attempt(self, stream: int, sequence: int, distance_m: float) -> float | None:
        """The delay of a message, s; None when it is lost."""
        failure = self.failure(distance_m)
        failed = 0
        while failure > 0.0 and uniform(stream, (_RETRIES_MAX + 1) * sequence + failed) < failure:
            failed += 1
            if failed > self.retries:
                return None
        travel_s = distance_m / self.speed_mps if self.speed_mps is not None else 0.0
        return failed * self.retry_s + travel_s
