"""Which orders in robots' recordings were given: those that an operator has sealed, or, where nothing is
sealed, those that most robots have.

A robot's computer can leave orders out of its recording, but not make one up: what it alone tells of is left
out, whatever time it says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median_low
from typing import Final, NamedTuple

from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Message, Mission, Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.security.sealed_order import Forged, Openers, unverified

DISTINCT_MAX: Final = 4096
"""Of one robot so many orders are looked at, the last ones: to look at a seal takes its time."""

Order = Mission | Stop | Resume


class Orders(NamedTuple):
    """`given`: each order once, by the time at which it was given first. `left_out`: by robot, how many that
    it recorded do not count."""

    given: Sequence[Order]
    left_out: Mapping[int, int]


def orders_given(
    recorded: Mapping[int, Iterable[bytes]], opener: Openers | None, voters: Callable[[int], int]
) -> Orders:
    """The orders that count of those that robots recorded, as they came.

    Args:
        recorded: by robot, the oldest first.
        opener: of the fleet's sealed orders; None: what most robots have counts, sealed or not.
        voters: how many robots should know of an order that was given at a time (wall clock, ns).
    """
    times: dict[Order, dict[int, int]] = {}
    """By content, when it was given, as each robot has it."""
    left_out: dict[int, int] = {}
    known: dict[bytes, Order | None] = {}
    for robot, payloads in recorded.items():
        distinct = list(dict.fromkeys(payloads))
        left_out[robot] = max(0, len(distinct) - DISTINCT_MAX)
        for payload in distinct[-DISTINCT_MAX:]:
            if payload not in known:
                known[payload] = _order(payload, opener)
            if (order := known[payload]) is None:
                left_out[robot] += 1
                continue
            said = times.setdefault(order._replace(time_ns=0), {})
            # It is sent again, each time with the time of then.
            said[robot] = min(order.time_ns, said.get(robot, order.time_ns))
    given = []
    for content, said in times.items():
        first_ns = min(said.values()) if opener is not None else median_low(said.values())
        if opener is not None or 2 * len(said) > voters(first_ns):
            given.append(content._replace(time_ns=first_ns))
            continue
        for robot in said:
            left_out[robot] += 1
    given.sort(key=lambda order: (order.time_ns, order.version))
    return Orders(given, {robot: count for robot, count in left_out.items() if count})


def _order(payload: bytes, opener: Openers | None) -> Order | None:
    """None for what is no order that is to be looked at."""
    try:
        message = _unsealed(payload) if opener is None else decode(opener.open_recorded(payload).payload)
    except (Malformed, Forged):
        return None
    return message if isinstance(message, (Mission, Stop, Resume)) else None


def _unsealed(payload: bytes) -> Message:
    try:
        return decode(payload)
    except Malformed:
        return decode(unverified(payload))
