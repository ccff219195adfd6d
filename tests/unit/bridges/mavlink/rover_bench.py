"""A simulated rover on the bench: what is sent to it, what it says, and time that only tests advance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.simulator.rover import Rover, Settings

# POSITION_TARGET_TYPEMASK, SET_ATTITUDE_TARGET: the setpoints of other programs than the bridge.
MASK_YAW_RATE = 0x5FF
"""A yaw rate alone: turns on the spot."""
MASK_VELOCITY = 0xDC7
"""A velocity vector: turns its heading to ``atan2(vy, vx)`` and drives forward, never in reverse."""
MASK_POSITION = 0xDFC
"""A place to go to; never times out."""
ATTITUDE_MASK_THRUST_AND_YAW_RATE = 0x83
"""Of SET_ATTITUDE_TARGET: speed ``thrust * WP_SPEED`` with ``body_yaw_rate``."""

ACCEPTED, DENIED, FAILED = constants.RESULT_ACCEPTED, constants.RESULT_DENIED, constants.RESULT_FAILED
HOME = Geodetic(47.3977, 8.5456, 488.0)
START_NS = 1_800_000_000 * NS_PER_S
STEP_NS = 5_000_000
Message = Any


class Bench:
    """`rover`, and what it said: `heard` is (time since the start in s, port, message), oldest first."""

    def __init__(self, **settings: Any) -> None:
        self.rover = Rover(Settings(**settings), START_NS)
        self.now_ns = START_NS
        self.heard: list[tuple[float, int, Message]] = []
        self.system = settings.get("system", 1)
        self._senders: dict[tuple[int, int, int], Any] = {}
        self.readers = [mavlink.MAVLink(None) for _ in range(settings.get("ports", 1))]
        for reader in self.readers:
            reader.robust_parsing = True

    @property
    def time(self) -> float:
        return (self.now_ns - START_NS) / NS_PER_S

    def sender(self, system: int = 255, component: int = 190, port: int = 0) -> Any:
        """The codec of somebody who sends by a port."""
        return self._senders.setdefault((system, component, port), mavlink.MAVLink(None, system, component))

    def send(self, message: Message, *, system: int = 255, component: int = 190, port: int = 0) -> None:
        codec = self.sender(system, component, port)
        data = message.pack(codec)
        codec.seq = (codec.seq + 1) % 256
        self.rover.receive(port, data, self.now_ns)

    def run(self, seconds: float, each: Callable[[], object] | None = None, period_s: float = 0.05) -> None:
        """Lets time pass; `each` is called every `period_s`, at first at once."""
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        due_ns = self.now_ns
        while self.now_ns < end_ns:
            if each is not None and self.now_ns >= due_ns:
                each()
                due_ns += round(period_s * NS_PER_S)
            self.now_ns = min(end_ns, self.now_ns + STEP_NS)
            for port, data in self.rover.advance(self.now_ns):
                for message in self.readers[port].parse_buffer(data) or ():
                    self.heard.append((self.time, port, message))

    def until(self, condition: Callable[[], object], most_s: float = 120.0) -> float:
        """Runs until something is true; when that was."""
        end = self.time + most_s
        while not condition():
            assert self.time < end, f"not within {most_s} s: {self.texts()}"
            self.run(STEP_NS / NS_PER_S)
        return self.time

    def of(self, name: str, since: float = 0.0, port: int | None = None) -> list[Message]:
        return [m for t, p, m in self.heard if m.get_type() == name and t >= since and port in (None, p)]

    def times(self, name: str, since: float = 0.0) -> list[float]:
        return [t for t, _, m in self.heard if m.get_type() == name and t >= since]

    def texts(self, since: float = 0.0) -> list[str]:
        return [m.text for m in self.of("STATUSTEXT", since)]

    def last(self, name: str) -> Message:
        return self.of(name)[-1]

    def command(self, command: int, *parameters: float, port: int = 0, **who: int) -> int:
        """Sends COMMAND_LONG, and returns the result that it was acknowledged with."""
        since = self.time
        filled = [*parameters, *[0.0] * (7 - len(parameters))]
        self.send(mavlink.MAVLink_command_long_message(self.system, 1, command, 0, *filled), port=port, **who)
        self.run(0.03)
        acks = [m for m in self.of("COMMAND_ACK", since, port) if m.command == command]
        assert acks, f"no acknowledgement of {command}"
        return int(acks[-1].result)

    def drive(
        self,
        speed: float = 0.5,
        yaw_rate: float = 0.0,
        *,
        mask: int = constants.MASK_SPEED_AND_YAW_RATE,
        frame: int = constants.FRAME_BODY_NED,
        vy: float = 0.0,
        x: float = 0.0,
        yaw: float = 0.0,
        system: int = 255,
        component: int = 190,
        port: int = 0,
    ) -> None:
        """One setpoint."""
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            0, self.system, 1, frame, mask, x, 0.0, 0.0, speed, vy, 0.0, 0.0, 0.0, 0.0, yaw, yaw_rate
        )
        self.send(message, system=system, component=component, port=port)

    def interval(self, message: int, rate_hz: float, port: int = 0) -> int:
        return self.command(constants.CMD_SET_MESSAGE_INTERVAL, message, 1e6 / rate_hz, port=port)

    def set_parameter(self, name: str, value: float, port: int = 0) -> None:
        self.send(
            mavlink.MAVLink_param_set_message(
                self.system, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
            ),
            port=port,
        )

    def heartbeat(self, *, system: int = 255, component: int = 190, port: int = 0) -> None:
        message = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
        self.send(message, system=system, component=component, port=port)


def ready(**settings: Any) -> Bench:
    """A rover that has been on for a while, in GUIDED and armed."""
    bench = Bench(boot="warm", hand_over=True, **settings)
    bench.run(0.1)
    assert bench.rover.armed
    assert bench.rover.mode == "GUIDED"
    return bench
