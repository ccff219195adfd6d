"""Carries out commands (COMMAND_LONG, COMMAND_INT) on a simulated rover, and acknowledges them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.simulator.port import Port
from handfast.bridges.mavlink.simulator.telemetry import BUILDERS, Message
from handfast.bridges.mavlink.simulator.vehicle import CRITICAL, INFO, Vehicle

SET_MODE: Final = mavlink.MAVLINK_MSG_ID_SET_MODE
"""What ArduPilot acknowledges a SET_MODE as, although it is a message and not a command."""
FORCES_ARMING: Final = frozenset({constants.FORCE_ARM, 2989})
"""The standard's number, and the one that ArduPilot has for arming."""


@dataclass(frozen=True, slots=True)
class Context:
    """Of one command: the vehicle, the port that it came by, a way to answer there, and the time."""

    vehicle: Vehicle
    port: Port
    answer: Callable[[Message | None], None]
    now_ns: int


def set_mode(vehicle: Vehicle, base_mode: int, custom_mode: int) -> int:
    """MAV_RESULT of a request for a mode."""
    if not base_mode & constants.FLAG_CUSTOM_MODE:
        return constants.RESULT_DENIED
    return constants.RESULT_ACCEPTED if vehicle.set_mode(custom_mode) else constants.RESULT_FAILED


def _whole(value: float) -> int:
    """A parameter that is a number of something; -1 for one that is none."""
    return round(value) if isfinite(value) else -1


def _mode(context: Context, parameters: Sequence[float]) -> int:
    return set_mode(context.vehicle, max(0, _whole(parameters[0])), _whole(parameters[1]))


def _arm(context: Context, parameters: Sequence[float]) -> int:
    wish = _whole(parameters[0])
    if wish == 1:
        armed = context.vehicle.arm(forced=_whole(parameters[1]) in FORCES_ARMING)
        return constants.RESULT_ACCEPTED if armed else constants.RESULT_FAILED
    if wish == 0:
        context.vehicle.disarm()
        return constants.RESULT_ACCEPTED
    return constants.RESULT_UNSUPPORTED


def _check(context: Context, _parameters: Sequence[float]) -> int:
    vehicle = context.vehicle
    if vehicle.armed:
        return constants.RESULT_TEMPORARILY_REJECTED
    if why := vehicle.arming_refused():
        vehicle.say(CRITICAL, f"PreArm: {why}")
    return constants.RESULT_ACCEPTED


def _reboot(context: Context, parameters: Sequence[float]) -> int:
    if _whole(parameters[0]) not in (1, 3):
        return constants.RESULT_UNSUPPORTED
    return constants.RESULT_FAILED if context.vehicle.armed else constants.RESULT_ACCEPTED


def _home(context: Context, _parameters: Sequence[float]) -> int:
    context.answer(BUILDERS[constants.MESSAGE_HOME_POSITION](context.vehicle, context.now_ns))
    return constants.RESULT_ACCEPTED if context.vehicle.navigation.ready else constants.RESULT_FAILED


def _message(context: Context, parameters: Sequence[float]) -> int:
    build = BUILDERS.get(_whole(parameters[0]))
    if build is None:
        return constants.RESULT_FAILED
    context.answer(build(context.vehicle, context.now_ns))
    return constants.RESULT_ACCEPTED


def _no_such_message(vehicle: Vehicle, message: int) -> int:
    vehicle.say(INFO, f"No ap_message for mavlink id ({message})")
    return constants.RESULT_DENIED


def _set_interval(context: Context, parameters: Sequence[float]) -> int:
    message = _whole(parameters[0])
    vehicle, port = context.vehicle, context.port
    if message not in BUILDERS:
        return _no_such_message(vehicle, message)
    asked_us = _whole(parameters[1])
    if asked_us in (-1, 0):
        port.set_interval(message, 0 if asked_us == -1 else -1, context.now_ns)
        return constants.RESULT_ACCEPTED
    asked_ms = max(1, asked_us // 1000)
    fastest_hz = constants.STREAM_RATE_PART * vehicle.parameters["SCHED_LOOP_RATE"]
    if asked_us < 0 or asked_ms * fastest_hz < 1000.0:
        return constants.RESULT_DENIED
    port.set_interval(message, asked_ms * 1_000_000, context.now_ns)
    return constants.RESULT_ACCEPTED


def _get_interval(context: Context, parameters: Sequence[float]) -> int:
    message = _whole(parameters[0])
    interval_ns = context.port.interval_ns(message)
    if interval_ns is None:
        return _no_such_message(context.vehicle, message)
    context.answer(mavlink.MAVLink_message_interval_message(message, interval_ns // 1000 or -1))
    return constants.RESULT_ACCEPTED


COMMANDS: Final[Mapping[int, Callable[[Context, Sequence[float]], int]]] = {
    constants.CMD_DO_SET_MODE: _mode,
    constants.CMD_COMPONENT_ARM_DISARM: _arm,
    constants.CMD_RUN_PREARM_CHECKS: _check,
    constants.CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    constants.CMD_GET_HOME_POSITION: _home,
    constants.CMD_GET_MESSAGE_INTERVAL: _get_interval,
    constants.CMD_SET_MESSAGE_INTERVAL: _set_interval,
    constants.CMD_REQUEST_MESSAGE: _message,
}
"""By their number: from the first three parameters to MAV_RESULT."""
