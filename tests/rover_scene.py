"""Rovers and bridges in virtual time: several on one vehicle's ports, and all that a bridge sends to it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.supervision.state_machine import at_rest
from handfast.bridges.mavlink.ardupilot import constants, frames
from handfast.bridges.mavlink.bridge.backend import MavlinkPlant, session
from handfast.bridges.mavlink.session.identity import Signing
from handfast.bridges.mavlink.simulator.in_memory import LATENCY_NS, STEP_NS
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.bridges.mavlink.simulator.settings import Settings, settings_of
from handfast.deploy.console.data_files import FLEETS
from handfast.plant.backend import Check, Command, Reading

START_NS = 1_800_000_000 * NS_PER_S
MASS = 20.0


def rovers(*overrides: str) -> Fleet:
    """The bundled fleet of rovers."""
    return resolved(load_fleet(FLEETS / "rovers.toml", overrides))


class Port:
    """A `bridges.mavlink.transport.transport.Transport` to one port of the rover of a `World`.

    `sent` is (time, bytes) of all that went out; `cut`: nothing passes.
    """

    def __init__(self, world: World, number: int) -> None:
        self._world, self._number = world, number
        self.arriving: deque[tuple[int, bytes]] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.trouble = self.note = ""
        self.transient = True
        self.epoch, self.dropped = 1, 0
        self.cut = False

    def receive(self) -> list[tuple[int, bytes]]:
        came = []
        while self.arriving and self.arriving[0][0] <= self._world.now_ns:
            came.append(self.arriving.popleft())
        return came

    def send(self, data: bytes) -> None:
        self.sent.append((self._world.now_ns, data))
        if not self.cut:
            self._world.to_rover.append((self._world.now_ns + LATENCY_NS, self._number, data))

    def close(self) -> None:
        pass

    def messages(self, name: str, since_ns: int = 0) -> list[tuple[int, Any]]:
        """Those of a name that went out at `since_ns` and later, with their times."""
        parser = mavlink.MAVLink(None)
        return [
            (at_ns, message)
            for at_ns, data in self.sent
            if at_ns >= since_ns
            for message in parser.parse_buffer(data) or ()
            if message.get_type() == name
        ]


class World:
    """A rover and its ports; time that only `advance` lets pass.

    As ArduPilot does, it passes heartbeats on to the other ports.
    """

    def __init__(self, settings: Settings) -> None:
        self.now_ns = START_NS
        self.rover = Rover(settings, START_NS)
        self.to_rover: deque[tuple[int, int, bytes]] = deque()
        self.ports = [Port(self, number) for number in range(settings.ports)]
        self._parsers = [mavlink.MAVLink(None) for _ in self.ports]

    def advance(self, now_ns: int) -> None:
        while self.now_ns < now_ns:
            self.now_ns = min(now_ns, self.now_ns + STEP_NS)
            while self.to_rover and self.to_rover[0][0] <= self.now_ns:
                _, number, data = self.to_rover.popleft()
                self.rover.receive(number, data, self.now_ns)
                if len(self.ports) > 1:
                    self._pass_on(number, data)
            for number, data in self.rover.advance(self.now_ns):
                if not self.ports[number].cut:
                    self.ports[number].arriving.append((self.now_ns + LATENCY_NS, data))

    def _pass_on(self, number: int, data: bytes) -> None:
        parser = self._parsers[number]
        parser.robust_parsing = True
        for message in parser.parse_buffer(data) or ():
            if message.get_type() == "HEARTBEAT":
                for port in self.ports:
                    if port is not self.ports[number] and not port.cut:
                        port.arriving.append((self.now_ns + LATENCY_NS, bytes(message.get_msgbuf())))


class Bridge:
    """A bridge at one port of a world, ticked by the scene."""

    def __init__(
        self, world: World, number: int, fleet: Fleet, token: int = 0, signing: Signing | None = None
    ) -> None:
        self.port, self.number = world.ports[number], number
        self.log: list[str] = []
        self.link = session(fleet, 1, signing, token or 1000 + number)
        self.plant = MavlinkPlant(fleet, 1, self.link, self.port, self.log.append)
        self.readings: list[Reading] = []
        self.command: Command | None = None
        self.born_ns = world.now_ns
        self.dead = False

    @property
    def reading(self) -> Reading:
        return self.readings[-1]

    def step(self, now_ns: int) -> None:
        if not self.dead:
            # No two processes tick within the same microsecond.
            self.readings.append(self.plant.step(now_ns + 7_000 * self.number, self.command))

    def setpoints(self, since_ns: int = 0) -> list[tuple[int, float, float]]:
        """Time, speed and yaw rate (FLU) of those that it sent at `since_ns` and later."""
        sent = self.port.messages("SET_POSITION_TARGET_LOCAL_NED", max(since_ns, self.born_ns))
        return [(at_ns, m.vx, frames.yaw_rate(m.yaw_rate)) for at_ns, m in sent]

    def clear_to_drive(self) -> None:
        self.plant.clear_to_drive()

    def check(self, name: str) -> Check:
        """The preflight line of that name."""
        checks = self.plant.checks(self.readings[-1].time_ns)
        found = [check for check in checks if check.name == name]
        assert found, f"no line {name}: {checks}"
        return found[0]

    @property
    def blocking(self) -> dict[str, str]:
        """Found, by the name of each blocking line."""
        checks = self.plant.checks(self.readings[-1].time_ns)
        return {check.name: check.found for check in checks if check.level == "blocking"}


class Scene:
    """Robot 1 of the rovers and its bridge at port 0; the operator is whoever calls the rover's methods.

    Args:
        overrides: of the fleet file.
        signing: of the bridge.
        settings: of the simulated rover, where they differ from `rover_settings`.
    """

    def __init__(self, *overrides: str, signing: Signing | None = None, **settings: Any) -> None:
        self.fleet = rovers(*overrides)
        self.world = World(replace(settings_of(self.fleet, 1), **settings))
        self.rover = self.world.rover
        self.bridges = [Bridge(self.world, 0, self.fleet, signing=signing)]
        self._datum = frames.datum_of(self.fleet)

    @property
    def bridge(self) -> Bridge:
        return self.bridges[0]

    @property
    def now_ns(self) -> int:
        return self.world.now_ns

    @property
    def time(self) -> float:
        return (self.now_ns - START_NS) / NS_PER_S

    @property
    def pose(self) -> Pose:
        """Where the rover really is, W."""
        x, y = frames.geodetic_to_world(self._datum, self.rover.place)
        return Pose(
            x,
            y,
            frames.heading_from_yaw(self.rover.yaw),
            self.rover.speed,
            frames.yaw_rate(self.rover.yaw_rate),
        )

    def tick(self) -> None:
        """One period of the fleet."""
        self.world.advance(self.now_ns + self.fleet.period_ns)
        for bridge in self.bridges:
            bridge.step(self.now_ns)

    def run(self, seconds: float, each: Callable[[], object] | None = None) -> None:
        """Lets time pass; `each` is called after every tick."""
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        while self.now_ns < end_ns:
            self.tick()
            if each is not None:
                each()

    def until(self, condition: Callable[[], object], most_s: float = 60.0) -> float:
        """Runs until something is true; how long that took, s."""
        begun = self.time
        if not self.bridge.readings:
            self.tick()
        while not condition():
            assert self.time < begun + most_s, (
                f"not within {most_s} s: {self.bridge.reading}, {self.rover.mode}, {self.bridge.log}"
            )
            self.tick()
        return self.time - begun

    def drive(self, speed: float = 0.5) -> None:
        """Waits until the rover obeys, gives the mission, and brings it to a speed."""
        self.until(lambda: self.bridge.reading.obeying)
        self.bridge.clear_to_drive()
        self.bridge.command = Command(MASS * 0.4 * (1.0 if speed > 0.0 else -1.0), 0.0)
        self.until(lambda: abs(self.bridge.reading.pose.speed) >= abs(speed) - 1e-9)
        self.bridge.command = Command(0.0, 0.0)
        self.until(lambda: abs(self.rover.speed) >= 0.9 * abs(speed))

    def say(self, message: Any, port: int = 1, system: int = 255, component: int = 190) -> None:
        """A ground station, or whoever, sends by a port."""
        self.world.ports[port].send(message.pack(mavlink.MAVLink(None, system, component)))


def heartbeat(kind: int = mavlink.MAV_TYPE_GCS, autopilot: int = constants.AUTOPILOT_INVALID) -> Any:
    """As a ground station sends."""
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, constants.STATE_ACTIVE, 3)


def set_mode(mode: int) -> Any:
    """SET_MODE, as most ground stations do it."""
    return mavlink.MAVLink_set_mode_message(1, constants.FLAG_CUSTOM_MODE, mode)


GO: Final = Command(MASS * 0.3, 0.0)
"""Ahead, faster and faster."""
STOPS_S: Final = 0.8
"""What a rover needs from 0.5 m/s to a stand."""


def take(rover: Rover, how: str) -> None:
    """Its operator takes it: by a mode, or by disarming it."""
    if how == "disarmed":
        rover.disarm()
    else:
        assert rover.set_mode(how)


def stands(scene: Scene) -> bool:
    return at_rest(scene.rover.speed, scene.rover.yaw_rate)
