"""Three rovers in virtual time, of which the second one fails: what it is asked, does, and says of itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import cos, hypot, sin
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.orders import OrderSection
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages.codec import decode
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.in_memory import MemoryTransport, SimulatedRoverPlant
from handfast.bridges.mavlink.simulator.rover import Rover
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.faults.process_actions import Action, What
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.simulate.simulation import LATENCY_NS, Simulation

FORMATION: Final = (
    "formation.edges=[[1,2],[1,3],[2,3]]",
    "formation.offsets=[[0.0,-1.732],[1.5,0.866],[-1.5,0.866]]",
    "trajectory.start_m=[0.0,0.0]",
    "robot.1.x_m=-0.4",
    "robot.1.y_m=-1.9",
    "robot.2.x_m=1.3",
    "robot.2.y_m=1.0",
    "robot.3.x_m=-2.0",
    "robot.3.y_m=0.7",
)
"""Three of the rovers in a triangle, near their places from the start."""
STEP_NS: Final = NS_PER_S // 20
PAIRS: Final = ((1, 2), (1, 3), (2, 3))
ROBOT: Final = 2
GROUND_STATION_PERIOD_NS: Final = NS_PER_S


def three(*overrides: str, rules: tuple[str, ...] = ()) -> Any:
    """The first three of the bundled fleet of rovers, with fault rules."""
    text = (FLEETS / "rovers.toml").read_text(encoding="utf-8")
    text = "[[robot]]".join(text.split("[[robot]]")[:4])
    text += "".join(f"\n[[faults.rule]]\n{rule}\n" for rule in rules)
    return resolved(parse_fleet(text, source="here", overrides=[*FORMATION, *overrides]))


class Hold:
    """Keeps a rover where it is until `free`: its wheels do not grip, or it has no motors."""

    def __init__(self, rover: Rover) -> None:
        self._truth: Any = rover._vehicle.truth
        self._step = self._truth.step
        self._truth.step = self._blocked

    def _blocked(self, *arguments: Any, **named: Any) -> None:
        truth = self._truth
        place = truth.north, truth.east, truth.yaw
        self._step(*arguments, **named)
        truth.north, truth.east, truth.yaw = place
        truth.speed = truth.yaw_rate = 0.0

    def free(self) -> None:
        """It moves again as it is asked to."""
        self._truth.step = self._step


class Watch:
    """What a bridge asks of its rover, and what that does and says, from `begin` on.

    Attributes: `asked`: setpoints (ns of sending, m/s, rad/s clockwise); `moved`: (ns, north m, east m, m/s,
    rad/s) in steps of 5 ms; `modes`: (ns, its mode and arming) of its heartbeats; `texts`: (ns, text).
    """

    def __init__(self, rover: Rover) -> None:
        self.asked: list[tuple[int, float, float]] = []
        self.moved: list[tuple[int, float, float, float, float]] = []
        self.modes: list[tuple[int, tuple[int, bool]]] = []
        self.texts: list[tuple[int, str]] = []
        self._rover = rover

    def begin(self, transport: MemoryTransport, now: Callable[[], int]) -> None:
        """Watches this way between the two, as long as it is not cut."""
        self._transport, self._now = transport, now
        self._to, self._from = mavlink.MAVLink(None), mavlink.MAVLink(None)
        self._send, self._advance = transport.send, self._rover.advance
        transport.send = self.send  # type: ignore[method-assign]
        self._rover.advance = self.advance  # type: ignore[method-assign]

    def send(self, data: bytes) -> None:
        """See `MemoryTransport.send`."""
        if not self._transport.cut:
            for message in self._to.parse_buffer(data) or ():
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    self.asked.append((self._now(), message.vx, message.yaw_rate))
        self._send(data)

    def advance(self, now_ns: int) -> list[tuple[int, bytes]]:
        """See `Rover.advance`."""
        out, rover = self._advance(now_ns), self._rover
        self.moved.append((now_ns, rover.north, rover.east, rover.speed, rover.yaw_rate))
        for _, data in out:
            for message in self._from.parse_buffer(data) or ():
                if message.get_type() == "HEARTBEAT":
                    armed = bool(message.base_mode & constants.FLAG_ARMED)
                    self.modes.append((now_ns, (message.custom_mode, armed)))
                elif message.get_type() == "STATUSTEXT":
                    self.texts.append((now_ns, message.text))
        return out


class Drive:
    """Three rovers in virtual time, recorded. Robot 2 is the one that fails.

    Args:
        parameters: of robot 2's vehicle, before its bridge asks for them.

    Attributes:
        ground_station: whether one is heard by robot 2's vehicle.
        said: (ns, message) of all that was said on the bus.
        closest: of two hand points in truth so far, m, looked at when time is let pass by `run`.
    """

    def __init__(
        self, duration_s: float, *overrides: str, parameters: Mapping[str, float] | None = None
    ) -> None:
        self._duration_s = duration_s
        self.fleet = three(f"fleet.duration_s={duration_s:g}", *overrides)
        self._data = RunData(self.fleet, mode="simulate")
        self.said: list[tuple[int, Any]] = []
        self.ground_station = False
        self.closest = float("inf")
        self._ground_station_ns = 0
        self.simulation = Simulation(self.fleet, self._hear)
        for name, value in (parameters or {}).items():
            self.rover.set_parameter(name, value)
        assert self.simulation.start(round(duration_s * NS_PER_S)), self.simulation.reasons

    def _hear(self, at_ns: int, key: str, payload: bytes) -> None:
        message = decode(payload)
        self._data.feed(at_ns, key, message)
        self.said.append((at_ns - LATENCY_NS, message))

    def body(self, robot: int = ROBOT) -> SimulatedRoverPlant:
        """The bridge and vehicle that a robot has now."""
        body = self.simulation._bodies._bodies[robot]
        assert isinstance(body, SimulatedRoverPlant)
        return body

    @property
    def rover(self) -> Rover:
        """Robot 2's."""
        return self.body().rover

    @property
    def now_ns(self) -> int:
        return self.simulation.now_ns

    @property
    def time_s(self) -> float:
        """Of the fleet."""
        return (self.now_ns - self.simulation.epoch_ns) / NS_PER_S

    def until(self, time_s: float) -> None:
        """Drives until a time of the fleet."""
        self.simulation.run_until(self.simulation.epoch_ns + round(time_s * NS_PER_S))

    def run(self, seconds: float) -> None:
        """The same; the vehicle goes on whether it has a bridge or not."""
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        while self.now_ns < end_ns:
            now_ns = min(end_ns, self.now_ns + STEP_NS)
            if self.ground_station and now_ns >= self._ground_station_ns:
                self._ground_station_ns = now_ns + GROUND_STATION_PERIOD_NS
                beat = mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, constants.AUTOPILOT_INVALID, 0, 0, constants.STATE_ACTIVE, 3
                )
                data = beat.pack(mavlink.MAVLink(None, constants.SYSTEM_GROUND_STATION, 190))
                self.rover.receive(0, data, self.now_ns)
            self.simulation.run_until(now_ns)
            self.vehicle_until_now()
            self.closest = min(self.closest, *(self.distance(*pair) for pair in PAIRS))

    def look(self) -> Watch:
        """Watches robot 2's bridge and vehicle from now on."""
        watch = Watch(self.rover)
        watch.begin(self.body().transport, lambda: self.now_ns)
        return watch

    def vehicle_until_now(self) -> None:
        """Time passes for robot 2's vehicle, not only when its bridge ticks."""
        self.body().transport.advance(self.now_ns)

    def distance(self, one: int, other: int) -> float:
        """Of two hand points in truth, m."""
        a, b = self.body(one).pose, self.body(other).pose
        offset = self.fleet.robot(one).hand_offset_m
        return hypot(
            a.x + offset * cos(a.heading) - b.x - offset * cos(b.heading),
            a.y + offset * sin(a.heading) - b.y - offset * sin(b.heading),
        )

    def process(self, role: str, what: What) -> None:
        """Does to a process of robot 2 what a signal does, or starts it again; nobody planned it."""
        simulation = self.simulation
        sink, simulation._sink = simulation._sink, None  # what rules do is recorded, and judged otherwise
        simulation._carry_out(Action(self.time_s, ROBOT, role, what, ""))
        simulation._sink = sink

    def order(self, kind: Any) -> None:
        """A stop or a resume for all."""
        self.simulation.give(OrderSection(at=0.0, kind=kind))

    def recording(self) -> Recording:
        """Drives to the end."""
        self.until(self._duration_s + 1.0)
        return self._data.recording()
