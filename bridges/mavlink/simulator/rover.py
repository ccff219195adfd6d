"""A simulated rover, sans-IO, as ArduPilot Rover was measured: bytes in, bytes out, time an argument.

`Rover` has no socket and no clock (`simulator.__main__` has them): joined to a bridge by `in_memory` it makes
tests in virtual time. It runs at the autopilot's loop rate; what arrives waits for the next loop.
"""

from __future__ import annotations

from typing import Final

from handfast.agent.common.random_streams import stream, uniform
from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.simulator.protocol import Protocol
from handfast.bridges.mavlink.simulator.settings import Settings, SettingsError
from handfast.bridges.mavlink.simulator.vehicle import Vehicle

__all__ = ["Rover", "Settings", "SettingsError"]

SILENT_BOOT: Final = 1.0 / 40.0
"""Of the time to boot: before it, nothing is heard or said."""


class Rover:
    """One simulated rover.

    Args:
        settings: who and where it is.
        now_ns: when it is switched on, ns of the wall clock; a warm one was, a while before.

    Deterministic: the same calls with the same arguments give the same bytes. A number that is not finite
    where it is used, or arming by force too early, ends it as it ends the autopilot: `crashed` says why,
    and it is silent.
    """

    def __init__(self, settings: Settings, now_ns: int) -> None:
        self.settings = settings
        self._vehicle = Vehicle(settings, now_ns)
        self._open = [True] * settings.ports
        self._log: list[str] = []
        self._crash_said = False
        # A loop's phase is the vehicle's own: a fleet's do not beat together.
        phase = uniform(stream("rover loop", settings.seed, settings.system), 0)
        self._last_ns = now_ns
        self._next_ns = now_ns + 1 + int(phase * (self._period_ns() - 1))
        cold_ns = self._silence_ns() if settings.boot == "cold" else 0
        self._switch_on(now_ns + cold_ns, settings.signing_key)

    def _period_ns(self) -> int:
        return round(NS_PER_S / self._vehicle.parameters["SCHED_LOOP_RATE"])

    def _silence_ns(self) -> int:
        return round(SILENT_BOOT * self.settings.boot_s * NS_PER_S)

    def _switch_on(self, awake_ns: int, key: bytes) -> None:
        self._awake_ns = awake_ns
        self._protocol = Protocol(self._vehicle, awake_ns, key)

    # What anybody may look at.

    @property
    def north(self) -> float:
        """m from `settings.home`, in truth."""
        return self._vehicle.truth.north

    @property
    def east(self) -> float:
        """m from `settings.home`, in truth."""
        return self._vehicle.truth.east

    @property
    def yaw(self) -> float:
        """rad clockwise from north, in truth; not wrapped."""
        return self._vehicle.truth.yaw

    @property
    def speed(self) -> float:
        """m/s along its heading, in truth."""
        return self._vehicle.truth.speed

    @property
    def yaw_rate(self) -> float:
        """rad/s clockwise, in truth."""
        return self._vehicle.truth.yaw_rate

    @property
    def place(self) -> Geodetic:
        """Where it is in truth."""
        return self._vehicle.place

    @property
    def mode(self) -> str:
        """Name of its mode."""
        return constants.mode_name(self._vehicle.mode)

    @property
    def armed(self) -> bool:
        """Whether its motors may turn."""
        return self._vehicle.armed

    @property
    def ready(self) -> bool:
        """Whether its EKF and GPS are."""
        return self._vehicle.navigation.ready

    @property
    def origin(self) -> Geodetic | None:
        """Of its EKF, once it has one."""
        return self._vehicle.navigation.origin

    @property
    def crashed(self) -> str:
        """Why its process ended; empty while it lives."""
        return self._vehicle.crashed

    @property
    def boots(self) -> int:
        """How often it was switched on."""
        return self._vehicle.boots

    @property
    def boot_ns(self) -> int:
        """When it was, last."""
        return self._vehicle.boot_ns

    @property
    def next_ns(self) -> int:
        """When its next loop runs."""
        return self._next_ns

    def take_log(self) -> list[str]:
        """What it did since this was asked last, for people."""
        log = self._log + self._protocol.log
        self._log, self._protocol.log = [], []
        return log

    # What an operator does by hand.

    def set_mode(self, name: str) -> bool:
        """By the transmitter's switch. Whether it is in that mode now. `SettingsError`: no such mode."""
        if name not in constants.MODE_NUMBERS:
            raise SettingsError(f"Rover has no mode {name}; it has {', '.join(constants.MODE_NUMBERS)}")
        return self._vehicle.set_mode(constants.MODE_NUMBERS[name])

    def arm(self) -> bool:
        """By the transmitter. Whether it is armed now."""
        return self._vehicle.arm()

    def disarm(self) -> None:
        """By the transmitter."""
        self._vehicle.disarm()

    def set_parameter(self, name: str, value: float) -> None:
        """As on the bench: nobody is told. Raises `SettingsError`."""
        self._vehicle.parameters.set(name, value)

    def reboot(self) -> None:
        """Off and on again where it stands; its parameters and its signing key stay."""
        key = self._protocol.key
        self._log = [*self.take_log(), "reboots"]
        self._vehicle.reboot(self._last_ns)
        self._switch_on(self._last_ns + self._silence_ns(), key)

    def set_open(self, port: int, is_open: bool) -> None:
        """Whether anybody is at a port: nothing is said to nobody. What was asked of it is kept."""
        self._open[port] = is_open

    # In time.

    def receive(self, port: int, data: bytes, now_ns: int) -> None:
        """Bytes that arrived at a port. Anything may be in them."""
        if not self.crashed and now_ns >= self._awake_ns:
            self._protocol.receive(port, data, now_ns)

    def advance(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Runs all loops that are due until `now_ns`. Returns what to send: port, and one message's bytes."""
        out: list[tuple[int, bytes]] = []
        while self._next_ns <= now_ns:
            loop_ns = self._next_ns
            self._loop(loop_ns)
            out += self._protocol.out
            self._protocol.out.clear()
            if self._protocol.reboot_asked:
                self.reboot()
            self._next_ns = loop_ns + self._period_ns()
        return out

    def _loop(self, now_ns: int) -> None:
        vehicle, protocol = self._vehicle, self._protocol
        awake = now_ns >= self._awake_ns and not vehicle.crashed
        if awake:
            # Before the step: what it says of itself is a loop old.
            protocol.serve(now_ns, self._open)
        vehicle.step(now_ns, (now_ns - self._last_ns) * 1e-9)
        self._last_ns = now_ns
        if awake and not vehicle.crashed:
            protocol.announce(now_ns)
        if vehicle.crashed and not self._crash_said:
            self._crash_said = True
            protocol.out.clear()
            self._log.append(f"crashed: {vehicle.crashed}")
