"""What a process hears of other robots in batches from a router, or singly where none makes any (PURE)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import batch, key_expressions
from handfast.agent.messages.validation import Malformed

SAID_NS: Final = NS_PER_S // 2
"""A router that has nothing to pass on sends an empty batch of beacons after so long."""
PATIENCE_NS: Final = 3 * NS_PER_S
"""Where no batch has come for so long, as from a zenohd, robots are listened to singly, until one comes. A
router that hangs is ended after as long (`agent.runtime.service`)."""
SINGLY_KEPT: Final = 64
"""So many hand states of each robot that came by themselves are known: when a router that stood goes on, all
that waited there come at once, and as many wait here (`agent.node.INBOX_SIZE`)."""
STOOD_NS: Final = NS_PER_S
"""Who looks less often stood, and so may the whole machine have: that time does not count. In a crowd that
has too little of a processor all would else begin to hear each robot by itself."""


class Batches:
    """What one process hears of the fleet `name`, of its `robots`.

    Args:
        hands: whether hand states come in batches, too: then it is enough to know whose are wanted.

    Attributes:
        keys: on which batches come.
        wants_each: whether robots are listened to singly, as no batches come.
    """

    def __init__(self, name: str, robots: Sequence[int], now_ns: int, *, hands: bool) -> None:
        self._name, self._robots = name, len(robots)
        self._beacon, self._hand = key_expressions.beacon_batch(name), key_expressions.hand_batch(name)
        self._each, self._hands = key_expressions.beacon(name, "*"), hands
        self.keys: Final = (self._beacon, self._hand) if hands else (self._beacon,)
        self.wants_each = False
        self._beacon_of = {robot: key_expressions.beacon(name, robot) for robot in robots}
        self._hand_of: dict[int, str] = {}
        """Of those that are listened to."""
        self._hand_said: dict[str, bytes] = {}
        self._singly: dict[str, set[bytes]] = {}
        """By key: the hand state that came last in a batch; those that came singly since the last such time
        began."""
        self._until_ns, self._looked_ns = now_ns + PATIENCE_NS, now_ns

    def instead_of(self, subscriptions: Sequence[str]) -> list[str]:
        """What to listen to instead, in the same order; what was asked for, of who listens to no robots."""
        if self._each not in subscriptions:
            return list(subscriptions)
        found: list[str] = []
        self._hand_of = {}
        for key in subscriptions:
            robot = key_expressions.robot_of_hand(self._name, key) if self._hands else None
            if robot is not None:
                self._hand_of[robot] = key
            if self.wants_each or (robot is None and key != self._each):
                found.append(key)
            if key == self._each:  # after what comes singly: a batch may hold what is newer
                found += self.keys
        return found

    def look(self, now_ns: int) -> bool:
        """Whether `wants_each` is not what it was; to be asked often."""
        self._until_ns += max(0, now_ns - self._looked_ns - STOOD_NS)
        self._looked_ns = now_ns
        before, self.wants_each = self.wants_each, now_ns >= self._until_ns
        if self.wants_each and not before:
            self._singly.clear()
        return self.wants_each is not before

    def opened(self, key: str, payload: bytes, now_ns: int) -> list[tuple[str, bytes]]:
        """What is wanted of a batch that came on `key`, (key, payload) as each robot said it. What is no
        batch comes as it is, to be refused and counted."""
        is_hand = key == self._hand
        try:
            said = batch.unpacked(payload, self._robots, self._hand_of if is_hand else self._beacon_of)
        except Malformed:
            return [(key, payload)]
        self._until_ns = now_ns + PATIENCE_NS
        return self._new_hands(said) if is_hand else said

    def came_singly(self, key: str, payload: bytes) -> None:
        """A message came by itself while `wants_each`: it may be in the next batch, too."""
        if key_expressions.robot_of_hand(self._name, key) is not None:
            came = self._singly.setdefault(key, set())
            if len(came) < SINGLY_KEPT:
                came.add(payload)

    def _new_hands(self, said: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        """Of hand states in a batch those that have not come yet: what links that fail do to each is told,
        and of none twice. Two routers may both make batches for a moment, and whoever is listened to singly
        is heard singly. (Of beacons, which are seldom, rather one twice than one that was missed.)
        """
        if self.wants_each:
            return []
        new = []
        for key, payload in said:
            if self._hand_said.get(key) != payload and payload not in self._singly.get(key, ()):
                self._hand_said[key] = payload
                new.append((key, payload))
        return new
