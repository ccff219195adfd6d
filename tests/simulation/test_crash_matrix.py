"""Who crashes, at which step of what an operator says, and who drives afterwards: nobody, unless ordered.

Real agents and plants in virtual time. The operator is gone as soon as it has said its word; robot 3's
computer may be out of reach of all others, and drives on or holds there; disks may be lost. docs/security.md
says why it comes out so.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Final

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.key_expressions import ROLES
from handfast.agent.messages.types import PlantState
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.faults.process_actions import Action
from handfast.deploy.simulate.simulation import Simulation
from tests.process.small_fleets import triangle

pytestmark = pytest.mark.patches

ALL: Final = (1, 2, 3)
AFTER_S: Final = 6.0
"""So long after the crash nobody has driven, or all do again."""


class Field:
    """A fleet in the middle of a drive, of which an operator has said its word and is gone."""

    def __init__(self, fleet: Fleet | None = None, *, cut_off: Iterable[int] = ()) -> None:
        self.drove: set[int] = set()
        self.simulation = Simulation(fleet or triangle(), self._hear)
        self._cut_off = frozenset(cut_off)
        put, rings_of = self.simulation._bus.put, self.simulation._bus._rings

        def passes(arrival_ns: int, key: str, payload: bytes) -> None:
            """As `put`, but nothing goes between those that are cut off and the others."""
            if not self._cut_off:
                put(arrival_ns, key, payload)
                return
            sender = _robot(key) in self._cut_off
            subscriptions = dict.fromkeys((key, key_expressions.of_any_robot(key)))
            for host, ring in chain.from_iterable(rings_of.get(name, {}).items() for name in subscriptions):
                if (_robot(host.node.alive_keys[0]) in self._cut_off) is sender:
                    ring.append((arrival_ns, key, payload))

        self.simulation._bus.put = passes  # type: ignore[method-assign]
        self.heal_first = self._cut_off
        self._cut_off = frozenset()
        assert self.simulation.start(300 * NS_PER_S)
        self.simulation._say_again = lambda: None  # type: ignore[method-assign]
        self.pass_s(3.0)
        assert self.drove == {robot.id for robot in self.simulation.fleet.robots if not robot.reserve}
        self._cut_off = self.heal_first

    def _hear(self, _now_ns: int, _key: str, payload: bytes) -> None:
        message = decode(payload)
        if isinstance(message, PlantState) and message.driving:
            self.drove.add(message.robot)

    def pass_s(self, time_s: float) -> None:
        self.simulation.run_until(self.simulation.now_ns + round(time_s * NS_PER_S))

    def say(self, kind: str) -> None:
        """The operator stops or resumes all."""
        operator, now_ns = self.simulation._operator, self.simulation.now_ns
        order = operator.order_stop(now_ns, "") if kind == "stop" else operator.order_resume(now_ns, ())
        self.simulation.publish(*operator.outgoing(order))

    def crash(self, robots: Iterable[int], *, disks: str = "kept", roles: Iterable[str] = ROLES) -> None:
        """These robots' processes are killed and start again, after all are gone.

        Args:
            disks: "kept"; "lost": new ones; "late": what came last was not written yet.
        """
        processes = [(robot, role) for robot in robots for role in roles]
        for process in processes:
            self._do(process, "kill")
        self.pass_s(0.3)
        for process in processes:
            host = self._host(process)
            if disks == "lost":
                host.kept = ()
            elif disks == "late":
                host.kept = self._before.get(process, ())
            self._do(process, "start")

    def remember_disks(self) -> None:
        """What disks hold now, for those that are late."""
        self._before = {
            process: self._host(process).kept for process in self.simulation._order
        }  # fmt: skip

    def _host(self, process: tuple[int, str]) -> object:
        return self.simulation._hosts[self.simulation._order[process]]

    def _do(self, process: tuple[int, str], what: str) -> None:
        self.simulation._carry_out(Action(0.0, *process, what, "a test"))  # type: ignore[arg-type]

    def driven(self, *, reachable: bool = True) -> set[int]:
        """Who drives after all this: those cut off are within reach again."""
        if reachable:
            self._cut_off = frozenset()
        self.pass_s(1.0)  # a robot that comes into reach is stopped by the first word it hears
        self.drove.clear()
        self.pass_s(AFTER_S)
        return set(self.drove)


def _robot(key: str) -> int | None:
    parts = key.split("/")
    return int(parts[parts.index("robot") + 1]) if "robot" in parts else None


# who crashes, and what is left of their disks
ONE, ONE_LOST = ((1,), "kept"), ((1,), "lost")
TWO, EVERYBODY, EVERYBODY_LOST = ((1, 2), "kept"), (ALL, "kept"), (ALL, "lost")


@pytest.mark.parametrize(("who", "disks"), [ONE, ONE_LOST, TWO, ((1, 2), "lost")])
def test_some_of_a_drive_that_goes_on_take_their_places(who: tuple[int, ...], disks: str) -> None:
    field = Field()
    field.crash(who, disks=disks)
    assert field.driven() == set(ALL)


@pytest.mark.parametrize("role", ROLES)
def test_so_does_one_process(role: str) -> None:
    field = Field()
    field.crash((2,), roles=(role,))
    assert field.driven() == set(ALL)


@pytest.mark.parametrize(("who", "disks"), [EVERYBODY, EVERYBODY_LOST])
def test_when_all_start_again_nobody_drives(who: tuple[int, ...], disks: str) -> None:
    field = Field()
    field.crash(who, disks=disks)
    assert field.driven() == set()
    if disks == "kept":  # until an operator says so
        field.say("resume")
        assert field.driven() == set(ALL)


@pytest.mark.parametrize(
    ("who", "disks"),
    [ONE, ONE_LOST, TWO, ((1, 2), "lost"), EVERYBODY, EVERYBODY_LOST, ((1, 2), "late"), (ALL, "late")],
)
@pytest.mark.parametrize("after_s", [0.0002, 0.03, 2.0])
def test_after_a_stop_nobody_drives_whoever_crashes(who: tuple[int, ...], disks: str, after_s: float) -> None:
    field = Field()
    field.remember_disks()
    field.say("stop")
    field.pass_s(after_s)
    field.crash(who, disks=disks)
    assert field.driven() == set()


@pytest.mark.parametrize("disks", ["kept", "lost"])
def test_after_a_resume_all_go_on_but_for_those_who_all_start_again(disks: str) -> None:
    field = Field()
    field.say("stop")
    field.pass_s(2.0)
    field.say("resume")
    field.pass_s(2.0)
    field.crash((1, 2), disks=disks)
    assert field.driven() == set(ALL)
    field.crash(ALL, disks=disks)
    assert field.driven() == set()


def test_who_was_out_of_reach_of_the_stop_starts_nobody_and_stands() -> None:
    """The fleet is stopped, robot 3 does not hear of it; the others start again, it comes back."""
    field = Field(cut_off=(3,))
    field.say("stop")
    field.pass_s(2.0)
    field.crash((1, 2))
    field.pass_s(2.0)
    assert field.driven() == set()


def test_nor_does_it_when_the_others_have_lost_their_disks_and_the_fleet_came_up_stopped() -> None:
    field = Field(cut_off=(3,))
    field.say("stop")
    field.pass_s(2.0)
    field.crash((1, 2), disks="lost")
    field.say("stop")  # as `up` says it, before anybody drives
    field.pass_s(2.0)
    assert field.driven() == set()


def delta() -> Fleet:
    return resolved(load_fleet(FLEETS / "delta.toml"))


@pytest.mark.parametrize("disks", ["kept", "lost"])
def test_those_who_drove_on_out_of_reach_are_stopped_by_what_the_others_kept(disks: str) -> None:
    """Four of six go on together, as they must. What stops them is a disk, or an `up`."""
    field = Field(delta(), cut_off=(3, 4, 5, 6))
    field.say("stop")
    field.pass_s(2.0)
    assert {3, 4, 5, 6} <= field.driven(reachable=False)
    field.crash((1, 2), disks=disks)
    if disks == "lost":
        field.say("stop")  # as `up` says it
    field.pass_s(2.0)
    assert field.driven() == set()


def test_a_stop_that_nobody_but_a_plant_has_kept_stops_that_body() -> None:
    field = Field()
    field.say("stop")
    field.pass_s(2.0)
    field.crash((1,), roles=("agent",), disks="lost")
    field.crash((2, 3), disks="lost")
    assert field.driven() == set()


def test_old_orders_said_again_by_whomever_do_nothing() -> None:
    field = Field()
    mission = field.simulation._operator.mission
    assert mission is not None
    field.say("stop")
    field.pass_s(2.0)
    field.crash(ALL)
    field.pass_s(1.0)
    key = f"{field.simulation.fleet.fleet.name}/robot/2/told"
    for _ in range(5):
        field.simulation.publish(key, encode(mission))
        field.simulation.publish(field.simulation._operator.keys[type(mission)], encode(mission))
        field.pass_s(0.2)
    assert field.driven() == set()
