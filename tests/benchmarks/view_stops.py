"""How soon a STOP on a page is obeyed, while nothing fails, and while robots lose 30 % of what they tell each
other.

A fault rule never touches an order (docs/faults.md). What it may slow is the robots that are to obey, whose
states change all the time, and the server, which tells of that.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Final

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from agent.fleet.model import Fleet
from agent.messages import key_expressions
from agent.messages.codec import decode
from agent.messages.types import PlantState
from deploy.session.joined_bus import OperatorBus
from deploy.session.operator_bus import operator_bus
from tests.benchmarks.processes import BenchmarkError

ARMS: Final = {"no fault": 0, "30 % lost": 30}
"""Per cent of the hand states that a rule on all links loses."""
RULE_S: Final = 600
"""A rule lasts for so long, unless it is healed, as it is."""
SETTLE_S: Final = 1.5
"""A rule begins a moment after all have it; and pages are told twice a second what was lost."""
PATIENCE_S: Final = 20.0
POLL_S: Final = 0.001


@dataclass
class Stops:
    """Of one arm: from the order to the last body that said that it brakes, ms; hand states that came, and
    that did not, meanwhile."""

    ms: list[float] = field(default_factory=list)
    received: int = 0
    lost: int = 0

    @property
    def lost_percent(self) -> float:
        return 100.0 * self.lost / max(1, self.received + self.lost)


def stops(fleet: Fleet, address: str, rounds: int, count: int) -> dict[str, Stops]:
    """What became of `count` stops in each of `rounds` turns of each arm."""
    found = {arm: Stops() for arm in ARMS}
    with operator_bus(fleet) as bus, _opened(address) as page:
        bus.subscribe(key_expressions.plant_state(fleet.fleet.name, "*"), 65_536)
        for number in range(rounds):
            for arm in [*ARMS][:: 1 if number % 2 == 0 else -1]:
                with _losing(page, ARMS[arm]):
                    received, lost = page.traffic()
                    found[arm].ms += [_stop(fleet, bus, page) for _ in range(count)]
                    time.sleep(SETTLE_S)
                    received_then, lost_then = page.traffic()
                    found[arm].received += received_then - received
                    found[arm].lost += lost_then - lost
    for arm, percent in ARMS.items():
        if found[arm].lost_percent < percent / 2:
            raise BenchmarkError(f"{arm}: only {found[arm].lost_percent:.0f} % of the hand states were lost")
    return found


class _Page:
    """A page without a browser: it reads what comes, as pages do, and orders."""

    def __init__(self, talk: ClientConnection) -> None:
        self._talk = talk
        self._orders = 0
        self.parts: dict[str, Any] = {}

    def read(self) -> None:
        """Reads until the connection ends: who answers nothing is gone."""
        frames = 0
        with suppress(ConnectionClosed):
            for said in self._talk:
                if isinstance(said, bytes):
                    frames += 1
                    self._talk.send(str(frames))
                else:
                    self.parts |= json.loads(said).get("parts", {})

    def order(self, content: Mapping[str, Any]) -> str:
        """Gives an order; returns the name by which the server tells of it."""
        self._orders += 1
        name = f"order {self._orders}"
        self._talk.send(json.dumps({"order": {**content, "id": name, "seen_s": time.time()}}))
        return name

    def wait(self, name: str) -> None:
        """Waits until the server tells that all have done an order."""

        def is_done() -> bool:
            told = next((each for each in self.parts.get("orders", ()) if each["id"] == name), None)
            if told is not None and "count" not in told:
                raise BenchmarkError(f"{told['what']} was refused: {'; '.join(told['lines'])}")
            return told is not None and told["count"][0] == told["count"][1]

        _until(is_done, lambda: f"{name} is not done by all: {self.parts.get('orders')}")

    def traffic(self) -> tuple[int, int]:
        """Hand states that came and that did not, over all links, since the robots began."""
        links = self.parts["links"]
        return sum(link[3] for link in links), sum(link[4] for link in links)


@contextmanager
def _opened(address: str) -> Iterator[_Page]:
    where, _, token = address.partition("#token=")
    origin = where.rstrip("/")
    where = f"{origin.replace('http', 'ws', 1)}/live"
    with connect(where, origin=Origin(origin), proxy=None, max_size=None) as talk:
        talk.send(json.dumps({"token": token}))
        page = _Page(talk)
        threading.Thread(target=page.read, daemon=True).start()
        _until(lambda: "links" in page.parts, lambda: "a page is told nothing of the links")
        yield page


@contextmanager
def _losing(page: _Page, percent: int) -> Iterator[None]:
    """A rule on all links that loses so many of the messages, by the page's own order."""
    if not percent:
        time.sleep(SETTLE_S)
        yield
        return
    rule = {"link": "*->*", "loss": f"{percent}%", "for": f"{RULE_S}s"}
    page.wait(page.order({"kind": "fault", "rule": rule}))
    time.sleep(SETTLE_S)
    yield
    page.wait(page.order({"kind": "heal"}))


def _stop(fleet: Fleet, bus: OperatorBus, page: _Page) -> float:
    """How long after a page has said STOP the last body said that it brakes, ms; then all may drive again."""
    _until_all(fleet, bus, driving=True)
    begun = time.monotonic()
    name = page.order({"kind": "stop"})
    _until_all(fleet, bus, driving=False)
    took_ms = (time.monotonic() - begun) * 1e3
    page.wait(name)  # a stop outdoes a resume that comes before all have acknowledged it
    page.order({"kind": "resume"})
    return took_ms


def _until_all(fleet: Fleet, bus: OperatorBus, *, driving: bool) -> None:
    """Waits until all bodies drive, or all brake."""
    states: dict[int, bool] = {}

    def are_so() -> bool:
        for _, payload in bus.drain():
            message = decode(payload)
            if type(message) is PlantState:
                states[message.robot] = message.driving
        return len(states) == len(fleet.ids) and set(states.values()) == {driving}

    _until(are_so, lambda: f"not all bodies {'drive' if driving else 'brake'}: {states}")


def _until(look: Callable[[], bool], what: Callable[[], str]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not look():
        if time.monotonic() > end:
            raise BenchmarkError(what())
        time.sleep(POLL_S)
