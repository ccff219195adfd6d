"""Loss models of a link: random, Gilbert-Elliott, four states, every n-th message (PURE).

The models are Markov chains whose state at any step is a pure function of the stream and the step's number,
so messages may arrive in any order. In each step all states move by the same uniform draw. Looking back a few
steps, all possible states have merged into one: the exact stationary state (coupling from the past, Propp and
Wilson 1996).

Step n uses the draws 4n to 4n + 3 of its stream: 4n moves the chain or is the event itself, 4n + 1 and 4n + 3
are free for its consequences, and 4n + 2 chooses the initial state.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate
from typing import Self, TypeAlias

from handfast.agent.common.quantities import correlation, named, ratio, shown, split, take_kind, text, whole
from handfast.agent.common.random_streams import uniform

Row: TypeAlias = tuple[tuple[int, float], ...]
"""Where one state goes: (state, probability), in the order in which a uniform number meets them; the last
takes the rest."""

_BLOCK_BITS = 12  # a chain that has not forgotten its past after 2^12 steps or more starts again
_STREAMS_MAX = 1 << 14
_last: dict[int, tuple[Chain, int, int]] = {}  # stream -> chain, step, state: for speed, never for a result


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """A chain of `len(stationary)` states; made by `chain`."""

    edges: tuple[float, ...]  # between these, a uniform number moves the states alike
    maps: tuple[tuple[int, ...], ...]  # how: the next state of each
    stationary: tuple[float, ...]

    def state(self, stream: int, step: int) -> int:
        """The state at a step, an integer."""
        block = step >> _BLOCK_BITS
        known, known_state = step + 1, 0  # none
        last = _last.get(stream)
        # Within a block all steps look back to the same start, and what one found holds for the next.
        if last is not None and last[0] is self and last[1] >> _BLOCK_BITS == block:
            _, known, known_state = last
        start = (block - 1) << _BLOCK_BITS
        states = tuple(range(len(self.stationary)))  # at `step`, of each possible state at `at`
        at = step
        while states.count(states[0]) != len(states):
            if at == known:
                found = states[known_state]
                break
            if at == start:
                found = states[self._draw(uniform(stream, 4 * start + 2))]
                break
            moved = self.maps[bisect_right(self.edges, uniform(stream, 4 * at))]
            states = tuple([states[k] for k in moved])
            at -= 1
        else:
            found = states[0]
        if len(_last) >= _STREAMS_MAX:
            _last.clear()
        _last[stream] = (self, step, found)
        return found

    def _draw(self, u: float) -> int:
        sums = list(accumulate(self.stationary))
        return next((k for k, total in enumerate(sums) if u < total), 0)


@lru_cache(maxsize=512)
def chain(rows: tuple[Row, ...], stationary: tuple[float, ...]) -> Chain:
    """The chain with these moves and this share of time in each state."""
    ends = [list(accumulate(probability for _, probability in row[:-1])) for row in rows]
    edges = sorted({end for row in ends for end in row if 0.0 < end < 1.0})
    maps = tuple(
        tuple(row[bisect_right(end, left)][0] for row, end in zip(rows, ends, strict=True))
        for left in (0.0, *edges)
    )
    return Chain(tuple(edges), maps, stationary)


def two_states(enter: float, stay: float, share: float) -> Chain:
    """States 0 and 1: the probability of 1 after 0 and after 1, and the share of time in 1."""
    return chain((((1, enter), (0, 1.0)), ((1, stay), (0, 1.0))), (1.0 - share, share))


def correlated(probability: float, correlation: float) -> Chain | None:
    """Events (state 1) of a probability whose successive indicators have a correlation; None without any.

    P(1 | 1) = p + c (1 - p) and P(1 | 0) = p (1 - c): rate and lag-1 correlation are exactly p and c. (netem
    compares p with averaged uniform numbers, which changes the rate: tc-netem(8) calls it deprecated.)
    """
    if correlation == 0.0:
        return None
    enter = probability * (1.0 - correlation)
    return two_states(enter, enter + correlation, probability)


def happens(stream: int, step: int, probability: float, chain: Chain | None) -> bool:
    """Whether an event of this probability happens at a step, `chain` being its `correlated`."""
    if chain is None:
        return uniform(stream, 4 * step) < probability
    return chain.state(stream, step) == 1


_KINDS = ("random", "gemodel", "state", "every")
_FORMS = {
    "random": ('"30%" or with a correlation "30% 25%"', ("loss", "correlation")),
    "gemodel": ('"gemodel P [R [1-H [1-K]]]", such as "gemodel 1% 10%"', ("p", "r", "1-h", "1-k")),
    "state": (
        '"state P13 [P31 [P32 [P23 [P14]]]]", such as "state 1% 10%"',
        ("p13", "p31", "p32", "p23", "p14"),
    ),
    "every": ('"every 3"', ("every",)),
}


@dataclass(frozen=True, slots=True)
class Loss:
    """Which messages are lost; names and parameters as in tc-netem(8).

    - random, "30%" or "30% 25%": a probability and the correlation of successive losses, exact as
      `agent.impairments.markov_chains.correlated` says;
    - gemodel, "gemodel p r 1-h 1-k", Gilbert (1960) and Elliott (1963): p is the probability to go from the
      good to the bad state, r to return, 1-h to lose a message in the bad state, 1-k in the good one. If not
      given: 1-p, 100 % and 0, as in netem;
    - state, "state p13 p31 p32 p23 p14", the four states of Salsano, Ludovici and Ordine: 1 received, 4 lost
      alone, 3 lost and 2 received within a burst. If not given: 1-p13, 0, 100 % and 0, as in netem;
    - every, "every 3": each third message by its sequence number.

    Chains are stationary from the first message on (netem's begin in their good state).
    """

    kind: str
    numbers: tuple[float, ...] = ()  # as they are written, with the defaults
    every: int = 0
    _chain: Chain | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_chain", _chain_of(self.kind, self.numbers))

    @classmethod
    def parse(cls, raw: object) -> Self:
        """From text or a ratio. ValueError."""
        words = split(raw, '"30%", "30% 25%", "gemodel 1% 10%", "state 1% 10%" or "every 3"')
        kind = take_kind(words, _KINDS) or "random"
        form, names = _FORMS[kind]
        if not 1 <= len(words) <= len(names):
            raise ValueError(f"must be written {form}, got {shown(raw)}")
        if kind == "every":
            return cls(kind, every=whole("every", words[0], 1, 10**6))
        if kind == "random":
            return cls(kind, (ratio(words[0]), correlation(words[1:])))
        given = tuple(named(name, ratio, word) for name, word in zip(names, words, strict=False))
        numbers = given + _defaults(kind, given[0])[len(given) :]
        if kind == "state":
            for one, other in ((0, 4), (1, 2)):
                if numbers[one] + numbers[other] > 1.0 + 1e-12:
                    raise ValueError(f"{names[one]} + {names[other]} must be at most 100%, got {shown(raw)}")
        return cls(kind, numbers)

    def __str__(self) -> str:
        if self.kind == "every":
            return f"every {self.every}"
        numbers, defaults = self.numbers, _defaults(self.kind, self.numbers[0])
        while len(numbers) > 1 and numbers[-1] == defaults[len(numbers) - 1]:
            numbers = numbers[:-1]
        words = [text(number, "ratio") for number in numbers]
        return " ".join(words if self.kind == "random" else [self.kind, *words])

    @property
    def rate(self) -> float:
        """The share of messages lost in the long run."""
        if self.kind == "every":
            return 1.0 / self.every
        if self.kind == "random" or self._chain is None:
            return self.numbers[0]
        share = self._chain.stationary
        if self.kind == "gemodel":
            return share[0] * self.numbers[3] + share[1] * self.numbers[2]
        return share[2] + share[3]

    def lost(self, stream: int, sequence: int) -> bool:
        """Whether a message is lost."""
        if self.kind == "random":
            return happens(stream, sequence, self.numbers[0], self._chain)
        if self._chain is None:
            return (sequence + 1) % self.every == 0
        state = self._chain.state(stream, sequence)
        if self.kind == "gemodel":
            return uniform(stream, 4 * sequence + 1) < self.numbers[2 if state else 3]
        return state >= 2


def _defaults(kind: str, first: float) -> tuple[float, ...]:
    if kind == "gemodel":
        return (first, 1.0 - first, 1.0, 0.0)
    return (first, 1.0 - first, 0.0, 1.0, 0.0) if kind == "state" else (first, 0.0)


def _chain_of(kind: str, numbers: tuple[float, ...]) -> Chain | None:
    """The chain of a model: good 0 and bad 1, received 0 and lost 1, or 0 .. 3 for the states 1 .. 4."""
    if kind == "random":
        return correlated(*numbers)
    if kind == "gemodel":
        p, r = numbers[:2]
        return two_states(p, 1.0 - r, p / (p + r) if p > 0.0 else 0.0)
    if kind == "every":
        return None
    p13, p31, p32, p23, p14 = numbers
    shares: tuple[float, ...]
    if p13 == 0.0:  # never leaves 1 and 4, where it begins
        shares = (1.0, 0.0, 0.0, p14)
    elif p23 == 0.0 < p32:  # never leaves 2
        shares = (0.0, 1.0, 0.0, 0.0)
    else:  # p13 s1 = p31 s3, p32 s3 = p23 s2, p14 s1 = s4
        shares = (p31, p13 * p32 / p23 if p32 > 0.0 else 0.0, p13, p14 * p31)
    # A small number leads 1, 2 and 3 to 3, a large one 1, 3 and 4 to 1: all states become one soon.
    rows = (
        ((2, p13), (3, p14), (0, 1.0)),
        ((2, p23), (1, 1.0)),
        ((2, max(0.0, 1.0 - p31 - p32)), (1, p32), (0, 1.0)),
        ((0, 1.0),),
    )
    total = sum(shares)
    return chain(rows, tuple(share / total for share in shares))
