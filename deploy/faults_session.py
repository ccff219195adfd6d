"""An operator's session with a running fleet: sends live fault rules, and hears who holds them."""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final

from agent import keys
from agent.bus import Bus
from agent.clock import RealClock
from agent.fleet import Fleet
from agent.messages import AUTHOR_MAX, Faults, Malformed, PlantState, decode, encode
from agent.node import FIRST_ROUND
from deploy.live_faults import Held, Receiver, receivers

INBOX: Final = 4096
POLL_S: Final = 0.02


class Session:
    """On the bus of `fleet`, connected to every agent and plant. A context manager.

    Attributes:
        held: what the receivers say that they hold.
        alive: the receivers that are there.
        epoch_ns: the mission's, as the plants' messages tell it; None until one has.

    Raises:
        agent.bus.BusError: the bus cannot be opened.
    """

    def __init__(self, fleet: Fleet) -> None:
        name = fleet.fleet.name
        self.fleet: Final = fleet
        self.receivers: Final = receivers(fleet)
        self.clock: Final = RealClock()
        self.author: Final = _author()
        self.held = Held(fleet)
        self.alive: set[Receiver] = set()
        self.epoch_ns: int | None = None
        self._version = 0
        self._key = keys.faults(name)
        self._bus = Bus(
            listen=[],
            connect=[
                fleet.agent_endpoint(robot) if role == "agent" else fleet.plant_endpoint(robot)
                for robot, role in self.receivers
            ],
        )
        self._bus.declare(self._key)
        for role in keys.ROLES:
            self._bus.subscribe(keys.faults_held(name, "*", role), INBOX)
        self._bus.subscribe(keys.plant_state(name, "*"))
        self._presence = self._bus.watch(keys.alive(name, "*", "*"))

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._bus.close()

    def now_ns(self) -> int:
        return self.clock.now_ns()

    def version(self) -> int:
        """The next version of this operator's messages: grows from message to message, and from author to
        author as long as their clocks are right."""
        newest = max((each.message.version for each in self.held.sets(self.now_ns())), default=0)
        self._version = max(self._version + 1, newest + 1, self.now_ns() // 1_000_000)
        return self._version

    def send(self, message: Faults) -> None:
        self._bus.publish(self._key, encode(message))

    def collect(self) -> None:
        """Takes what came."""
        known = set(self.receivers)
        for key, here in self._presence.update():
            receiver = keys.robot_of_alive(key)
            if receiver in known:
                if here:
                    self.alive.add(receiver)
                else:
                    self.alive.discard(receiver)
                    self.held.forget(receiver)
        for key, payload in self._bus.drain():
            try:
                message = decode(payload)
            except Malformed:
                continue
            if type(message) is Faults:
                self.held.feed(key, message)
            elif type(message) is PlantState and message.sequence >= FIRST_ROUND:
                rounds = message.sequence - FIRST_ROUND
                self.epoch_ns = message.time_ns - rounds * self.fleet.period_ns

    def wait(self, look: Callable[[], bool], timeout_s: float) -> bool:
        """Collects until `look` says True; False when it has not within `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while True:
            self.collect()
            if look():
                return True
            if time.monotonic() >= deadline:
                return False
            self.pause()

    def pause(self) -> None:
        """A moment's wait, until something may have come."""
        time.sleep(POLL_S)


def _author() -> str:
    """Who this is: ``user@host:pid``."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # an id without a name
        user = str(os.getuid())
    text = f"{user}@{socket.gethostname()}"
    pid = f":{os.getpid()}"
    return "".join(c if c.isprintable() else "?" for c in text)[: AUTHOR_MAX - len(pid)] + pid
