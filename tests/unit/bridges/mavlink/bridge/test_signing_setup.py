"""Keys given to simulated rovers in virtual time, and what preflight says of signing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.plants import MavlinkSection
from handfast.bridges.mavlink.bridge.signing_setup import (
    CONFIRM_NS,
    GIVE_MAX,
    PERIOD_NS,
    VEHICLE_NS,
    Outcome,
    SigningSetup,
    give_keys,
)
from handfast.bridges.mavlink.session.identity import (
    Signing,
    Timestamps,
    make_key,
    open_signing,
    session_settings,
)
from handfast.bridges.mavlink.simulator.settings import settings_of
from tests.rover_scene import START_NS, Bridge, Scene, World, heartbeat, rovers

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))


class Bench:
    """A setup at one port of a rover that is switched on and disarmed, unless `settings` say otherwise."""

    def __init__(
        self, folder: Path, *, port: int = 0, system: int | None = None, stamps_ns: int = 0, **settings: Any
    ) -> None:
        common = replace(settings_of(rovers(), 1), hand_over=False, ports=2)
        self.world = World(replace(common, **settings))
        self.rover = self.world.rover
        self.port = self.world.ports[port]
        self.stamps = Timestamps(folder / "stamp", START_NS + stamps_ns)
        settings = session_settings(MavlinkSection(system=system), token=7)
        self.setup = SigningSetup(settings, Signing(KEY, self.stamps), self.port)

    def run(self, each: Callable[[], object] = lambda: None) -> Outcome:
        """Until there is an outcome; `each` is called after every step."""
        while self.setup.outcome is None:
            assert self.time < 60.0
            self.world.advance(self.world.now_ns + PERIOD_NS)
            self.setup.step(self.world.now_ns)
            each()
        return self.setup.outcome

    @property
    def time(self) -> float:
        return (self.world.now_ns - START_NS) / NS_PER_S

    @property
    def given(self) -> list[Any]:
        """The SETUP_SIGNING messages that were sent."""
        return [message for _, message in self.port.messages("SETUP_SIGNING")]


MakeBench = Callable[..., Bench]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[MakeBench]:
    made: list[Bench] = []

    def make(**settings: Any) -> Bench:
        made.append(Bench(tmp_path, **settings))
        return made[-1]

    yield make
    for each in made:
        each.setup.close()


@pytest.mark.parametrize("port", [0, 1])
def test_a_disarmed_rover_is_given_the_key_and_signs_with_it(bench: MakeBench, port: int) -> None:
    made = bench(port=port)
    assert made.run() == Outcome(True, "signs with its key from now on (system 1)")
    (given,) = made.given
    assert bytes(given.secret_key) == KEY
    assert (given.target_system, given.target_component) == (1, 1)
    assert made.stamps.latest >= given.initial_timestamp > (made.world.now_ns - START_NS) // 10_000
    assert made.rover.take_log().count("signs from now on") == 1
    assert made.time < 6.0


@pytest.mark.parametrize("armed", [False, True])
def test_one_that_has_the_key_is_not_given_it_again(bench: MakeBench, armed: bool) -> None:
    made = bench(port=1, signing_key=KEY, hand_over=armed)
    assert made.run() == Outcome(True, "had its key already, and signs (system 1)")
    assert made.given == []


@pytest.mark.parametrize("port", [0, 1])
def test_one_with_another_key_keeps_it(bench: MakeBench, port: int) -> None:
    made = bench(port=port, signing_key=OTHER_KEY)
    outcome = made.run()
    assert not outcome.done
    assert "signs with another key" in outcome.text
    assert made.given == []


def test_an_armed_one_is_refused(bench: MakeBench) -> None:
    made = bench(hand_over=True)
    outcome = made.run()
    assert not outcome.done
    assert "disarm it first" in outcome.text
    assert made.given == []


@pytest.mark.parametrize("system", [None, 1])
def test_of_several_on_a_link_the_one_that_is_named(bench: MakeBench, system: int | None) -> None:
    made = bench(system=system)
    other = mavlink.MAVLink(None, 9, 1)

    def speak() -> None:
        beat = heartbeat(mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)
        made.port.arriving.append((made.world.now_ns, beat.pack(other)))

    outcome = made.run(speak)
    assert outcome.done is (system is not None)
    assert bool(made.given) is (system is not None)
    if system is None:
        assert outcome.text == "systems 1, 9 are on this link: say which is meant, with mavlink.system"


def test_one_that_does_not_sign_is_told(bench: MakeBench) -> None:
    made = bench()
    outcome = made.run(made.world.to_rover.clear)
    assert not outcome.done
    assert outcome.text.startswith("it was given the key and does not sign with it: ")
    assert len(made.given) == GIVE_MAX
    assert made.time < 4.0 + CONFIRM_NS / NS_PER_S


def test_silence_and_a_closed_connection_are_told(bench: MakeBench) -> None:
    made = bench()
    made.port.cut = True
    assert made.run() == Outcome(False, "no heartbeat of a vehicle yet")
    assert made.time == pytest.approx(VEHICLE_NS / NS_PER_S, abs=0.1)
    closed = bench()
    closed.port.cut, closed.port.trouble = True, "cannot open tcp:1.2.3.4:5760: connection refused"
    assert closed.run() == Outcome(False, closed.port.trouble)


class Ticking:
    """A clock by which time passes only while somebody sleeps."""

    def __init__(self, worlds: list[World]) -> None:
        self._worlds = worlds

    def now_ns(self) -> int:
        return self._worlds[0].now_ns

    def sleep_until(self, time_ns: int) -> None:
        for world in self._worlds:
            world.advance(time_ns)

    def begin(self, epoch_ns: int) -> None:
        pass


def test_an_interrupt_ends_it(bench: MakeBench) -> None:
    made = bench()
    made.port.cut = True
    clock = Ticking([made.world])
    give_keys({1: made.setup}, clock, lambda: made.time > 1.0, lambda *_: pytest.fail("no outcome"))
    assert made.setup.outcome is None
    assert made.time < 1.2


def test_a_key_in_the_users_home_and_the_timestamps_of_the_bridge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    key = make_key(tmp_path / "key")
    signing = open_signing("rovers", 3, "~/key", START_NS)
    signing.timestamps.close()
    assert signing.key == key
    assert (tmp_path / "state" / "handfast" / "signing-rovers-3").is_file()


# ---------------------------------------------------------------------- what preflight says


MakeScene = Callable[..., Scene]


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[MakeScene]:
    """A bridge, with `key` or none, at one port of a rover with `vehicle_key` or none."""
    stamps: list[Timestamps] = []

    def make(key: bytes, vehicle_key: bytes, port: int = 0) -> Scene:
        file = ['robot.1.mavlink.signing_key="/nowhere"'] if key else []
        made = Scene(*file, ports=2, signing_key=vehicle_key)
        signing = None
        if key:
            stamps.append(Timestamps(tmp_path / "bridge", START_NS))
            signing = Signing(key, stamps[-1])
        made.bridges[:] = [Bridge(made.world, port, made.fleet, signing=signing)]
        return made

    yield make
    for each in stamps:
        each.close()


def test_a_bridge_without_a_key_is_told_that_the_vehicle_takes_nothing_unsigned(scene: MakeScene) -> None:
    made = scene(b"", KEY, port=1)
    made.run(1.5)
    first = made.bridge.check("signing")
    assert (first.level, first.found) == ("blocking", "waiting for an answer to what is not signed")
    made.run(8.0)
    line = made.bridge.check("signing")
    assert (line.level, line.found) == (
        "blocking",
        "the vehicle signs, and takes nothing that is not signed",
    )
    assert line.advice == "name its key in mavlink.signing_key"


@pytest.mark.parametrize("vehicle_key", [b"", OTHER_KEY], ids=["unsigned", "another_key"])
def test_a_vehicle_without_the_key_is_one_for_this_command(scene: MakeScene, vehicle_key: bytes) -> None:
    made = scene(KEY, vehicle_key)
    made.run(3.0)
    line = made.bridge.check("link")
    assert line.level == "blocking"
    assert "handfast keys --signing" in line.advice
