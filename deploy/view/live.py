"""Serves the page of a running fleet, over a bus that is connected to all its processes."""

from __future__ import annotations

import asyncio
import secrets
import ssl
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.transport.bus import Bus
from handfast.deploy.playback.page import served_policy
from handfast.deploy.session.stop import Way
from handfast.deploy.view.beside import StartUnderWay
from handfast.deploy.view.controls import Controls
from handfast.deploy.view.faults import FaultUnderWay, HealUnderWay, LiveFaults
from handfast.deploy.view.live_fleet import LiveFleet
from handfast.deploy.view.moves import order_to_move
from handfast.deploy.view.orders import ChangeUnderWay
from handfast.deploy.view.pages import Pages
from handfast.deploy.view.server import LOOPBACK, Answer, Server, page_files

TOKEN_BYTES: Final = 16


class LiveServer:
    """The server of the page of `fleet` (resolved, as its robots read it).

    Args:
        ways: makes the ways of a stop besides the links of `bus`; None: nothing can be ordered.
        source: the fleet file that the robots read, with which a mission can be started; None: it cannot be.
        port, host, names, tls: as of a `Server`.

    Attributes:
        address: what to open in a browser: with the token, without which nobody is told anything.

    Raises:
        OSError: the address cannot be had, or the port is taken.
    """

    def __init__(
        self,
        fleet: Fleet,
        bus: Bus,
        ways: Callable[[], Sequence[Way]] | None,
        port: int = 0,
        *,
        source: str | None = None,
        host: str = LOOPBACK,
        names: frozenset[str] = frozenset(),
        tls: ssl.SSLContext | None = None,
    ) -> None:
        token = secrets.token_urlsafe(TOKEN_BYTES)
        self.live: Final = LiveFleet(fleet, bus)
        self.controls: Final = None if ways is None else self._controls(bus, ways, source)
        self.pages: Final = Pages(self.live, token, self.controls)
        self.pages.steps.append(self._ask)
        if self.controls is not None:
            self.pages.steps.append(self.controls.step)
        self.live.put("controls", [] if self.controls is None else [*self.controls.kinds])
        self._has_ended = False
        files = page_files("live")
        self._server = Server(files, served_policy(), port, self.pages.talk, host=host, names=names, tls=tls)
        # Behind the "#", where it is not sent to anybody, nor written into a log.
        self.address: Final = f"{self._server.address}#token={token}"

    def _controls(self, bus: Bus, ways: Callable[[], Sequence[Way]], source: str | None) -> Controls:
        live = self.live
        state, fleet = live.fleet_state, live.fleet
        faults = LiveFaults(state, bus)
        controls = Controls(state, ways, lambda told: live.put("orders", told))
        controls.kinds["move"] = lambda content: ChangeUnderWay(
            state, order_to_move(content, state.operator.plan, fleet)
        )
        controls.kinds["fault"] = lambda content: FaultUnderWay(faults, content)
        controls.kinds["heal"] = lambda _: HealUnderWay(faults)
        if source is not None:
            controls.kinds["start"] = lambda content: StartUnderWay(
                source, len(fleet.ids), resume=content.get("resume") is True
            )
        live.listeners.extend((controls.feed, faults.feed))
        return controls

    def _ask(self) -> None:
        """Asks for what was ordered before, where it was not heard."""
        self.live.fleet_state.ask()

    def end(self) -> None:
        """The drive is over: nothing of the fleet is followed any more, and pages keep what they have."""
        if not self._has_ended:
            self._has_ended = True
            self.pages.steps.clear()
            self.pages.take_no_more()
            self.live.put("over", True)
            self.live.number += 1

    def show(self, answer: Answer) -> None:
        """From now on pages get this recording, those that are open as well."""
        self.end()
        self._server.answer = answer
        self.live.put("reload", True)
        self.live.number += 1

    async def serve(self) -> None:
        """Follows the fleet and serves its page until this is cancelled."""
        tasks = [asyncio.create_task(each) for each in (self.pages.run(), self._server.serve())]
        try:
            await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            for task in tasks:
                with suppress(asyncio.CancelledError):
                    await task

    def close(self) -> None:
        """Gives the port back."""
        self._server.close()
        self.end()
