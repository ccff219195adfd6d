"""The links of one bus, looked at one by one where something may have changed, and else all at once."""

from __future__ import annotations

import time
from typing import Final

from handfast.agent.common.time import NS_PER_S
from handfast.agent.transport.link_watch import SOON_NS, LinkWatch
from handfast.agent.transport.tcp_sockets import Calm, Lingering, TcpSockets

WHOLE_LOOK_NS: Final = 10 * NS_PER_S
"""So often links are looked at one by one though none seems to have changed."""


class TcpLinks:
    """The links of one bus, to be looked at when it is time to.

    Attributes:
        due_ns: when that is, of a clock that is never set.
    """

    def __init__(self, watch: LinkWatch) -> None:
        self._watch, self._sockets, self._lingering, self._calm = watch, TcpSockets(), Lingering(), Calm()
        self._whole_due_ns = self.due_ns = 0

    def look(self, now_ns: int) -> list[str]:
        """Looks at all links now; returns as `LinkWatch.look`. Mostly nothing has changed, which a few system
        calls tell."""
        watch = self._watch
        if now_ns < self._whole_due_ns and self._calm.lasts():
            watch.still_calm(now_ns)
            self.due_ns = now_ns + (SOON_NS if self._calm.waits else watch.period_ns)
            return []
        self._whole_due_ns = now_ns + WHOLE_LOOK_NS
        found, deaf = self._sockets.look(), []
        if found is not None:
            self._lingering.end(found)
            deaf = watch.look(found, now_ns)
            if watch.calm is not None and self._lingering.is_done:
                self._calm.begin(watch.calm)
                # One that was opened meanwhile is among neither these nor what `Calm` takes for new.
                if self._sockets.look() != found:
                    self._calm.end()
            else:
                self._calm.end()
        self.due_ns = now_ns + watch.period_ns
        return deaf

    def look_at_opening(self) -> None:
        """Looks at them while the first of them is being opened."""
        self._watch.look(self._sockets.look() or (), time.monotonic_ns())

    def give_up(self) -> None:
        """See `LinkWatch.give_up`."""
        self._watch.give_up(self._sockets.look() or ())

    def reopen(self, endpoint: str) -> bool:
        """See `LinkWatch.reopen`."""
        return self._watch.reopen(endpoint, self._sockets.look() or ())
