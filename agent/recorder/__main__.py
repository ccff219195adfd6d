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

from handfast.agent.common.errors import BAD_INPUT, FAILED, PASSED
from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, load_fleet, read_text
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.messages import key_expressions
from handfast.agent.recorder.folder import FolderInUseError, RecordingFolder, recording_files
from handfast.agent.recorder.recorder import About, Received, RobotRecorder, known_orders, order_keys
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import StartError, logger, open_bus, robot_arguments
from handfast.agent.runtime.service import Shutdown, SystemdNotifier, wait_until_valid
from handfast.agent.runtime.version import handfast_version
from handfast.agent.security.identity import of_robot
from handfast.agent.transport.bus import Bus, BusError

POLL_S: Final = 0.05
"""Time between two looks at the bus, s."""
INBOX: Final = 20_000
"""Messages that may wait on the bus: a minute of a robot at 50 Hz."""
LOOK_BACK: Final = 32
"""Number of newest files that are searched for orders."""
FOR_GOOD: Final = (errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.EACCES, errno.EPERM)
"""Errors of a folder that another start does not mend."""
NICE: Final = 10
"""Whatever else a robot's computer does comes first."""
STEP_NS: Final = NS_PER_S // 2
"""Change of the wall clock against the monotonic one above which it counts as set."""


def about(fleet: Fleet, fleet_toml: str, robot: int) -> About:
    """Return whose recording it is."""
    if not fleet.is_resolved:  # else without numpy, which takes its time
        from handfast.agent.formation.geometry import resolved

        fleet = resolved(fleet)
    return About(fleet.fleet.name, digest(fleet), robot, handfast_version(), fleet_toml)


def known(path: Path, orders: frozenset[str]) -> list[Received]:
    """Return the orders in the newest readable file of a folder that holds any."""
    with suppress(OSError):
        for file in recording_files(path)[: -LOOK_BACK - 1 : -1]:
            with suppress(OSError):
                if found := known_orders(file, orders):
                    return found
    return []


def record(bus: Bus, recorder: RobotRecorder, shutdown: Shutdown, systemd: SystemdNotifier) -> None:
    """Records until the process is asked to end and all is on the disk.

    Raises:
        OSError: nothing can be recorded any more.
    """
    offset_ns = time.time_ns() - time.monotonic_ns()
    while not shutdown.asked:
        time.sleep(POLL_S)
        now_ns = time.time_ns()
        before_ns, offset_ns = offset_ns, now_ns - time.monotonic_ns()
        if abs(offset_ns - before_ns) >= STEP_NS:
            recorder.set_clock(now_ns, (offset_ns - before_ns) / NS_PER_S)
        _hear(bus, recorder, now_ns)
        systemd.lives(time.monotonic_ns())
        shutdown.look_for_parent()
    systemd.stopping()
    _hear(bus, recorder, time.time_ns())
    while not recorder.is_idle:  # a disk that stalls
        time.sleep(POLL_S)
        systemd.lives(time.monotonic_ns())
    recorder.end_file(time.time_ns())


def _hear(bus: Bus, recorder: RobotRecorder, now_ns: int) -> None:
    for key, payload in bus.drain():
        recorder.add(now_ns, key, payload)
    recorder.flush_if_due(now_ns)


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
            systemd.ready()  # a disk that is full must not look like a start that fails
            with (
                RecordingFolder(path, fleet.recording.max_mb * 1_000_000) as folder,
                _bus(fleet, robot, options.keys, log) as bus,
            ):
                bus.subscribe(key_expressions.everything(fleet.fleet.name), INBOX)
                log(f"recording into {path}, at most {fleet.recording.max_mb} MB")
                orders = order_keys(whose.fleet, robot)
                with RobotRecorder(folder, whose, orders, known(path, orders), log) as recorder:
                    record(bus, recorder, shutdown, systemd)
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
