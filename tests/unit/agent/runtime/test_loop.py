"""The loop of a process, by a clock that stands still until it is slept by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, parse_fleet
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Mission, PlantState, Stop
from handfast.agent.node import Node
from handfast.agent.runtime.loop import ROUTER_PAUSE_NS, OrderKeeper, look_at_links, loop
from handfast.agent.runtime.process import names_of
from handfast.agent.runtime.service import Shutdown, SystemdNotifier
from handfast.agent.transport.bus import Bus
from handfast.plant.node import PlantNode
from handfast.plant.unicycle import from_fleet

pytestmark = pytest.mark.patches

FLEET = """
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 2, y_m = 0 }]
fleet = { name = "two", rate_hz = 50 }
formation = { edges = [[1, 2]], distance_m = 1.0, safe_distance_m = 0.2 }
faults = { rule = [%s] }
"""
T0 = 1000 * NS_PER_S
PERIOD = 20_000_000
STATE_KEY = "two/robot/1/plant/state"


class Clock:
    """Sleeps as long as it is asked to, and now and then too long; a look at it takes no time."""

    def __init__(self, oversleeps: dict[int, int]) -> None:
        self.time_ns = T0 + 1
        self.oversleeps = oversleeps
        self.epochs: list[int] = []

    def now_ns(self) -> int:
        return self.time_ns

    def sleep_until(self, time_ns: int) -> None:
        self.time_ns = max(self.time_ns, time_ns) + self.oversleeps.get(time_ns, 0)

    def begin(self, epoch_ns: int) -> None:
        self.epochs.append(epoch_ns)


class Wire:
    """The bus: gives each of `incoming` once its time has come, and keeps what is published."""

    def __init__(self, clock: Clock, incoming: dict[int, tuple[str, bytes]]) -> None:
        self._clock, self._incoming = clock, incoming
        self.stamps: list[int] = []
        self.listened: list[Sequence[str]] = []
        self.deaf: list[str] = []

    def listen(self, subscriptions: Sequence[str]) -> None:
        self.listened.append(subscriptions)

    def drain(self) -> Iterator[tuple[str, bytes]]:
        for time_ns in sorted(self._incoming):
            if time_ns <= self._clock.time_ns:
                yield self._incoming.pop(time_ns)

    def were_deaf(self) -> list[str]:
        found, self.deaf = self.deaf, []
        return found

    def publish(self, key: str, payload: bytes) -> None:
        message = decode(payload)
        if key == STATE_KEY:
            assert isinstance(message, PlantState)
            self.stamps.append(message.time_ns)


class Ended:
    """Stands for `Shutdown`: asks for the end after so many ticks."""

    def __init__(self, ticks: int) -> None:
        self._left = ticks
        self.why = "enough"

    @property
    def asked(self) -> bool:
        self._left -= 1
        return self._left < 0

    def look_for_parent(self) -> None: ...


def looped(
    rules: str, oversleeps: dict[int, int], ticks: int
) -> tuple[PlantNode, Clock, list[int], list[str]]:
    fleet = parse_fleet(FLEET % rules, source="here")
    node = PlantNode(fleet, 1, from_fleet(fleet, 1))
    clock = Clock(oversleeps)
    mission = Mission(1, T0, T0 + NS_PER_S, 60 * NS_PER_S, digest(fleet))
    wire = Wire(clock, {T0 + 2 * PERIOD: ("two/mission", encode(mission))})
    said: list[str] = []
    loop(node, cast(Bus, wire), clock, cast(Shutdown, Ended(ticks)), said.append, SystemdNotifier({}))
    return node, clock, wire.stamps, said


def test_a_tick_is_told_its_deadline_and_those_slept_through_are_skipped():
    late = {T0 + 2 * PERIOD: PERIOD // 2, T0 + 4 * PERIOD: 2 * PERIOD + 7}
    _, _, stamps, said = looped("", late, 5)
    assert [(stamp - T0) / PERIOD for stamp in stamps] == [1, 2, 3, 6, 7, 8]
    assert said == ["braking: no wrench yet", "missed 2 of 8 ticks", "ending (enough)"]


class Laid:
    """Stands for `OrderKeeper`: a stop is found from a tick on."""

    def __init__(self, node: PlantNode, from_ns: int) -> None:
        self._node, self._from_ns = node, from_ns
        self.conditions: list[str] = []

    def look(self, now_ns: int) -> None:
        if now_ns == self._from_ns:
            self._node.receive(now_ns, "two/stop", encode(Stop(T0 // 1000, T0, "lunch")))

    def step(self) -> None:
        self.conditions.append(self._node.condition[1])


def test_a_stop_that_was_laid_there_holds_from_the_tick_on_at_which_it_is_found():
    fleet = parse_fleet(FLEET % "", source="here")
    node, clock = PlantNode(fleet, 1, from_fleet(fleet, 1)), Clock({})
    laid = Laid(node, T0 + 3 * PERIOD)
    bus, ended = cast(Bus, Wire(clock, {})), cast(Shutdown, Ended(4))
    loop(node, bus, clock, ended, [].append, SystemdNotifier({}), keeper=cast(OrderKeeper, laid))
    assert laid.conditions == ["no wrench yet"] * 2 + ["stop: lunch"] * 2 + ["the plant was told to end"]


def test_ticks_are_late_where_a_rule_wants_it():
    _, _, stamps, _ = looped("{ robot = 1, tick_jitter = 0.005 }", {}, 20)
    late = [stamp % PERIOD for stamp in stamps]
    assert len(set(late)) == len(late) == 21
    assert max(late) < 5_000_000
    assert [stamp // PERIOD for stamp in stamps] == [T0 // PERIOD + k for k in range(1, 22)]


def test_the_clock_is_told_of_the_epoch_as_soon_as_it_is_known():
    _, clock, stamps, _ = looped("", {}, 5)
    assert len(stamps) == 6
    assert clock.epochs == [T0 + NS_PER_S]  # once: the clock keeps it


def test_what_others_give_as_a_reason_stays_on_its_line():
    fleet = parse_fleet(FLEET % "", source="here")
    node = PlantNode(fleet, 1, from_fleet(fleet, 1))
    clock = Clock({})
    stop = Stop(1, T0, "here\nrobot 2 plant: all is well")
    wire = Wire(clock, {T0: ("two/stop", encode(stop))})
    said: list[str] = []
    loop(node, cast(Bus, wire), clock, cast(Shutdown, Ended(3)), said.append, SystemdNotifier({}))
    assert "braking: stop: here\\nrobot 2 plant: all is well" in said


class Told(SystemdNotifier):
    """What systemd is told that the process does."""

    def __init__(self) -> None:
        super().__init__({})
        self.texts: list[str] = []

    def says(self, text: str) -> None:
        self.texts.append(text)


def test_another_reason_for_the_same_state_is_told_though_not_logged_and_not_too_often():
    fleet = parse_fleet(FLEET % "", source="here")
    node = PlantNode(fleet, 1, from_fleet(fleet, 1))
    clock, said, service = Clock({}), list[str](), Told()
    stops = {T0 + k * NS_PER_S // 4: Stop(1 + k, T0, f"reason {k}") for k in range(9)}
    wire = Wire(clock, {at: ("two/stop", encode(stop)) for at, stop in stops.items()})
    loop(node, cast(Bus, wire), clock, cast(Shutdown, Ended(200)), said.append, service)
    told = [text for text in service.texts if "reason" in text]
    assert said[0] == told[0] == "braking: stop: reason 0"
    assert not [text for text in said[1:] if "reason" in text]
    assert told[-1] == "braking: stop: reason 8"
    assert len(told) <= 4


@pytest.mark.parametrize("early_ns", [1, 400_000])
def test_a_tick_that_begins_early_is_told_its_deadline(early_ns: int):
    """A sleep may end a little too soon."""
    _, _, stamps, _ = looped("", {T0 + 2 * PERIOD: -early_ns}, 3)
    assert [(stamp - T0) / PERIOD for stamp in stamps] == [1, 2, 3, 4]


class Links:
    """A bus with links: those that were deaf, and those that are open."""

    def __init__(self, deaf: Sequence[str], opened: Sequence[str]) -> None:
        self._deaf, self._open = list(deaf), opened
        self.opened_anew: list[str] = []
        self.pauses_ns: list[int] = []

    def were_deaf(self) -> list[str]:
        return self._deaf

    def reopen(self, endpoint: str, pause_ns: int = 0) -> bool:
        self.opened_anew.append(endpoint)
        self.pauses_ns.append(pause_ns)
        return endpoint in self._open


class Listener:
    """A node that is deaf to some robots."""

    def __init__(self, *robots: int) -> None:
        self._robots = robots
        self.told: list[str] = []

    def deaf_to(self, now_ns: int) -> Sequence[int]:
        return self._robots

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        self.told.append(what)


def test_links_that_were_deaf_are_said_and_those_that_others_hear_opened_anew():
    fleet = parse_fleet(FLEET % "", source="here")
    first, second = fleet.agent_endpoint(1), fleet.agent_endpoint(2)
    names = names_of(fleet, 1)
    for endpoints, who in (
        ([second, ""], ["robot 2", "one that had connected to it"]),
        ([first, fleet.plant_endpoint(1)], ["its agent", "its plant"]),
    ):
        node, links, log = Listener(), Links(endpoints, []), list[str]()
        look_at_links(cast(Node, node), cast(Bus, links), T0, names, log.append)
        assert log == node.told == [f"was deaf to {each}: link opened anew" for each in who]
        assert links.opened_anew == []
    for opened, said in (([second], ["deaf to robot 2: link opened anew"]), ([], [])):
        node, links = Listener(2), Links([], opened)
        log = []
        look_at_links(cast(Node, node), cast(Bus, links), T0, names, log.append)
        assert links.opened_anew == [second]
        assert log == node.told == said


def test_who_is_deaf_to_somebody_behind_a_router_opens_the_link_to_that_anew_now_and_then():
    fleet = parse_fleet(FLEET % "", source="here", overrides=['network.routers=["here:7447"]'])
    node, links, log = Listener(2), Links([], ["tcp/here:7447"]), list[str]()
    look_at_links(cast(Node, node), cast(Bus, links), T0, names_of(fleet, 1), log.append)
    assert log == ["deaf to robot 2: link opened anew"]
    assert links.opened_anew == [fleet.agent_endpoint(2), "tcp/here:7447"]
    assert links.pauses_ns == [0, ROUTER_PAUSE_NS]


def test_routers_and_others_plants_have_names():
    routers = parse_fleet(FLEET % "", source="here", overrides=['network.routers=["here:7447"]'])
    names = names_of(routers, 2)
    assert names["tcp/here:7447"] == "the router at here:7447"
    assert names[routers.plant_endpoint(1)] == "robot 1's plant"
