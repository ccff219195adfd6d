"""Random draws that are pure functions of what they are for.

A draw depends on a key (seed, purpose, robot, ...) and a counter, never on the order in which
draws are made: two processes, or a run and its simulation, that draw for the same thing draw the
same. The generator is SplitMix64 (Steele, Lea, Flood 2014) as a counter-based hash.
"""

from __future__ import annotations

from hashlib import blake2b
from math import cos, log, pi, sqrt

_MASK = (1 << 64) - 1
_GOLDEN = 0x9E3779B97F4A7C15


def stream(*key: int | str) -> int:
    """A 64-bit number for a stream of draws, from whatever names it (a seed, ids, words)."""
    text = "\x1f".join(f"{type(part).__name__}:{part}" for part in key)
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def bits(stream: int, counter: int) -> int:
    """64 random bits: draw number `counter` of a stream."""
    z = (stream + (counter + 1) * _GOLDEN) & _MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)


def uniform(stream: int, counter: int) -> float:
    """A number in [0, 1) with 53 random bits."""
    return (bits(stream, counter) >> 11) * 2.0**-53


def normal(stream: int, counter: int) -> float:
    """A standard normal number (Box & Muller 1958); uses the uniforms 2 counter and 2 counter + 1."""
    radius = sqrt(-2.0 * log(1.0 - uniform(stream, 2 * counter)))
    return radius * cos(2.0 * pi * uniform(stream, 2 * counter + 1))
