"""Markov chains whose state at any time is a pure function of the stream and the time (PURE).

All states of a chain move by the same uniform number of each step. Looking back from a step, after a few more
every state that the chain may have been in has become the same one: that is its state, exactly stationary,
whatever happened before (coupling from the past, Propp and Wilson 1996). So messages may come in any order.

Of a stream, step n uses the draws 4n .. 4n + 3: 4n moves the chain or is the event itself, 4n + 1 and 4n + 3
are free for what follows from it, 4n + 2 is where a chain starts.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import TypeAlias

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
