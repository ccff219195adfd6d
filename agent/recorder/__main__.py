"""``python -m handfast.agent.recorder --fleet FILE --robot ID --folder DIR``: records what one robot says.

A process of its own on the robot's computer: a slow disk stalls only this one. It is linked to the robot's
agent and plant and to nobody else, and it publishes nothing. Peers do not relay, so it hears what these
two say, orders included, which agents relay when they take them.
"""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from handfast.agent.common.exit import BAD_INPUT, FAILED, PASSED
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet, read_text
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.messages import key_expressions
from handfast.agent.recorder.recorder import AGAIN, RETRY_NS, RobotRecorder, known_orders, order_keys
from handfast.agent.recorder.segment_folder import PASSING, FolderInUseError, SegmentFolder, segment_paths
from handfast.agent.recorder.segments import About, Received
from handfast.agent.recorder.writer_thread import RecorderThread
from handfast.agent.runtime.certificate_wait import wait_until_valid
from handfast.agent.runtime.clock import RealClock
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import StartError, logger, open_bus, robot_arguments
from handfast.agent.runtime.shutdown import Shutdown
from handfast.agent.runtime.systemd_notify import SystemdNotifier
from handfast.agent.runtime.version import handfast_version
from handfast.agent.security.identity import of_robot
from handfast.agent.transport.bus import Bus, BusError

POLL_S: Final = 0.05
"""Time between two looks at the bus, s."""
INBOX_S: Final = 60
"""A recorder that does not get to run for so long misses nothing."""
MESSAGES_PER_TICK: Final = 5.5
"""What one robot says, statuses and what it relays included."""
INBOX_MIN: Final = 4096
"""Smallest inbox, messages."""
LOOK_BACK: Final = 32
"""So many of the newest segments are asked for orders."""
FOR_GOOD: Final = (errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.EACCES, errno.EPERM)
"""Errors of a folder that another start does not mend."""
NICE: Final = 10
"""Whatever else a robot's computer does comes first."""
STEP_NS: Final = NS_PER_S // 2
"""By how much the wall clock may drift from the monotonic one before it counts as set."""
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class _WallClock:
    """The wall clock, carried on by the monotonic one until somebody sets it."""

    def __init__(self) -> None:
        self._clock = RealClock()

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def stepped_ns(self) -> int:
        """By how much it was set since the last call, 0 when it was not; it goes on as it is now."""
        off_ns = time.time_ns() - self._clock.now_ns()
        if abs(off_ns) < STEP_NS:
            return 0
        self._clock = RealClock()
        return off_ns


def about(fleet: Fleet, fleet_toml: str, robot: int) -> About:
    """Whose the segments of a robot are. Their numbers and times are still 0."""
    if not fleet.is_resolved:  # else without numpy, which takes its time
        from handfast.agent.formation.geometry import resolved

        fleet = resolved(fleet)
    try:
        boot = _BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        boot = ""
    return About(fleet.fleet.name, digest(fleet), robot, handfast_version(), boot, 0, 0, fleet_toml)


def known(path: Path, orders: frozenset[str]) -> list[Received]:
    """The orders in the newest segment of a folder that holds any: the newest of all may be damaged or cut.
    None where there is none that can be read."""
    with suppress(OSError):
        for segment in segment_paths(path)[: -LOOK_BACK - 1 : -1]:
            with suppress(OSError):
                if found := list(known_orders(segment, orders)):
                    return found
    return []


def inbox_size(fleet: Fleet) -> int:
    """Messages of one robot that may wait to be heard."""
    return max(INBOX_MIN, round(INBOX_S * MESSAGES_PER_TICK * fleet.fleet.rate_hz))


def record(
    bus: Bus, inbox: int, thread: RecorderThread, shutdown: Shutdown, systemd: SystemdNotifier
) -> None:
    """Records what comes until the process is asked to end and all is on the disk.

    Args:
        inbox: as many messages may wait on the bus.

    Raises:
        OSError: nothing can be recorded any more.
    """
    clock = _WallClock()

    def hear() -> None:
        now_ns = clock.now_ns()
        messages = list(bus.drain())
        step_s = clock.stepped_ns() / NS_PER_S
        thread.hear(now_ns, messages, overflow=len(messages) >= inbox, step_s=step_s)

    while not shutdown.asked:
        time.sleep(POLL_S)
        hear()
        if thread.error is not None:
            raise thread.error
        systemd.lives(time.monotonic_ns())
        shutdown.look_for_parent()
    systemd.stopping()
    hear()
    thread.end()
    while thread.working:  # a disk that stalls
        time.sleep(POLL_S)
        systemd.lives(time.monotonic_ns())
    if thread.error is not None:
        raise thread.error


def _open(
    path: Path, bytes_max: int, shutdown: Shutdown, systemd: SystemdNotifier, log: Log
) -> SegmentFolder | None:
    """The folder, once the disk lets it be made; None when the process is asked to end before."""
    said = False
    while not shutdown.asked:
        try:
            return SegmentFolder(path, bytes_max)
        except OSError as error:
            if error.errno not in PASSING:
                raise
            if not said:
                log(f"not recording: cannot make {path} ({error.strerror}); {AGAIN}")
            said = True
        deadline = time.monotonic() + RETRY_NS / NS_PER_S
        while time.monotonic() < deadline and not shutdown.asked:
            time.sleep(POLL_S)
            systemd.lives(time.monotonic_ns())
            shutdown.look_for_parent()
    return None


def _bus(fleet: Fleet, robot: int, folder: str | None, log: Log) -> Bus:
    os.nice(NICE)  # before Zenoh's threads are there, which have the niceness of who starts them
    endpoints = [fleet.agent_near(robot), fleet.plant_near(robot)]
    ends: dict[str, Any] = {"listen": [], "connect": endpoints, "through_routers": False}
    # An order without its seal proves nothing to who fetches the recording.
    return open_bus(fleet, robot, folder, log, **ends, keep_seals=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process. Returns its exit status: 0 when it was asked to end, 1 when it cannot begin now, 2
    for bad input."""
    parser = robot_arguments("python -m handfast.agent.recorder", "Records what one robot of a fleet says.")
    parser.add_argument("--folder", required=True, type=Path, metavar="DIR", help="where the recording goes")
    options = parser.parse_args(argv)
    shutdown = Shutdown(with_parent=options.exit_with_parent)
    robot, path = options.robot, options.folder
    log = logger(f"robot {robot}", "recorder")
    try:
        fleet = load_fleet(options.fleet)
        whose = about(fleet, read_text(options.fleet, "fleet file"), robot)

        def asked() -> bool:
            shutdown.look_for_parent()
            return shutdown.asked

        with SystemdNotifier() as systemd:
            identity = of_robot(fleet.fleet.name, robot) if fleet.is_secured else None
            wait_until_valid(identity, options.keys, asked, systemd, log)
            systemd.ready()  # it does its work: a disk that is full must not look like a start that fails
            folder = _open(path, fleet.recording.max_mb * 1_000_000, shutdown, systemd, log)
            if folder is None:
                return PASSED
            with (
                folder,
                _bus(fleet, robot, options.keys, log) as bus,
            ):
                inbox = inbox_size(fleet)
                bus.subscribe(key_expressions.everything(fleet.fleet.name), inbox)
                log(f"recording into {path}, at most {fleet.recording.max_mb} MB")
                orders = order_keys(whose.fleet, robot)
                recorder = RobotRecorder(folder, whose, orders, known(path, orders), log)
                with RecorderThread(recorder) as thread:
                    record(bus, inbox, thread, shutdown, systemd)
                log(f"ending ({shutdown.why})")
    except (FleetError, StartError) as error:
        log(str(error))
        return BAD_INPUT
    except (BusError, FolderInUseError) as error:
        log(str(error))
        return FAILED
    except OSError as error:
        log(f"cannot record into {path}: {error.strerror or type(error).__name__}")
        return BAD_INPUT if error.errno in FOR_GOOD else FAILED
    return PASSED


if __name__ == "__main__":
    sys.exit(main())
