"""A ground station for tests, in real time: an operator's hand on mode, arming and parameters."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.transport.transport import Transport
from tests.process.harness import PATIENCE_S, wait_for


class Operator:
    """A ground station: system 255 on a vehicle's connection, with nothing but MAVLink.

    It does something only in `poll`, which every wait calls.

    Args:
        transport: to the vehicle; closed with the operator.
        name: of the vehicle or connection, for what is said when a wait fails.
        system: the vehicle's id; None: the first autopilot that is heard.
        meanwhile: what else is to be done while it waits.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        system: int | None = None,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> None:
        self._transport, self._name, self.meanwhile = transport, name, meanwhile
        self._codec = mavlink.MAVLink(None, constants.SYSTEM_GROUND_STATION, 190)
        self._codec.robust_parsing = True
        self._due = 0.0
        self.system = system
        self.mode: int | None = None
        self.armed = False
        self.heard_at = float("-inf")
        self.texts: deque[str] = deque(maxlen=200)
        self.parameters: dict[str, float] = {}
        self.latest: dict[str, Any] = {}

    def __enter__(self) -> Operator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._transport.close()

    def send(self, message: Any) -> None:
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self._transport.send(data)

    def poll(self) -> None:
        """Takes what came, and sends the heartbeat when it is due."""
        for _, data in self._transport.receive():
            for message in self._codec.parse_buffer(data) or ():
                self._take(message)
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + 1.0
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, constants.AUTOPILOT_INVALID, 0, 0, constants.STATE_ACTIVE, 3
                )
            )

    def _take(self, message: Any) -> None:
        if message.get_srcComponent() != constants.COMPONENT_AUTOPILOT:
            return
        if message.get_type() == "HEARTBEAT" and self.system is None:
            self.system = message.get_srcSystem()
        if message.get_srcSystem() != self.system:
            return
        kind = message.get_type()
        self.latest[kind] = message
        if kind == "HEARTBEAT":
            self.mode, self.armed = message.custom_mode, bool(message.base_mode & constants.FLAG_ARMED)
            self.heard_at = time.monotonic()
        elif kind == "STATUSTEXT":
            self.texts.append(message.text)
        elif kind == "PARAM_VALUE":
            self.parameters[message.param_id] = message.param_value

    def wait(self, look: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
        def poll_and_look() -> Any:
            self.meanwhile()
            self.poll()
            return look()

        return wait_for(
            poll_and_look,
            f"{self._name}: {what}",
            timeout_s,
            lambda: f"mode {self.mode}, armed {self.armed}, {list(self.texts)}, {self._transport.trouble}",
        )

    def connect(self, timeout_s: float = PATIENCE_S) -> None:
        """Waits for the vehicle's heartbeat."""
        since = time.monotonic()
        self.wait(lambda: self.heard_at > since, "a heartbeat", timeout_s)

    def _again_until(
        self, ask: Callable[[], None], look: Callable[[], Any], what: str, timeout_s: float
    ) -> None:
        due = 0.0

        def ask_and_look() -> Any:
            nonlocal due
            if time.monotonic() >= due:
                due = time.monotonic() + 1.0
                ask()
            return look()

        self.connect(timeout_s)
        self.wait(ask_and_look, what, timeout_s)

    def command(self, number: int, *values: float) -> None:
        filled = [*values, *[0.0] * (7 - len(values))]
        self.send(mavlink.MAVLink_command_long_message(self.system, 1, number, 0, *filled))

    def set_mode(self, name: str, timeout_s: float = PATIENCE_S) -> None:
        """Asks until the vehicle's heartbeat says that it is in that mode."""
        mode, custom = constants.MODE_NUMBERS[name], constants.FLAG_CUSTOM_MODE
        self._again_until(
            lambda: self.send(mavlink.MAVLink_set_mode_message(self.system, custom, mode)),
            lambda: self.mode == mode,
            f"mode {name}",
            timeout_s,
        )

    def arm(self, armed: bool = True, timeout_s: float = PATIENCE_S) -> None:
        """Asks until the vehicle is armed or disarmed; it says why not by STATUSTEXT."""
        self._again_until(
            lambda: self.command(constants.CMD_COMPONENT_ARM_DISARM, 1.0 if armed else 0.0),
            lambda: self.armed is armed,
            "armed" if armed else "disarmed",
            timeout_s,
        )

    def set_parameter(self, name: str, value: float, timeout_s: float = PATIENCE_S) -> None:
        self.parameters.pop(name, None)
        self._again_until(
            lambda: self.send(
                mavlink.MAVLink_param_set_message(
                    self.system, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32
                )
            ),
            lambda: self.parameters.get(name) == value,
            f"{name} = {value:g}",
            timeout_s,
        )
