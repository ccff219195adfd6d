"""``python -m agent.recorder_process --fleet FILE --robot ID --folder DIR``: records what one robot says.

A process of its own on the robot's computer: a slow disk stalls only this one. It is linked to the robot's
agent and plant and to nobody else, and it publishes nothing. Peers do not relay, so it hears what these
two say, orders included, which agents tell on when they take them.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from agent import keys
from agent.bus import Bus, BusError
from agent.clock import NS_PER_S, RealClock
from agent.fleet import Fleet, FleetError, digest, load_fleet, read_text
from agent.process import (
    BAD_INPUT,
    FAILED,
    Log,
    Shutdown,
    StartError,
    logger,
    open_bus,
    robot_arguments,
)
from agent.robot_recorder import AGAIN, RETRY_NS, RobotRecorder, known_orders, order_keys
from agent.segment_folder import PASSING, FolderInUseError, SegmentFolder, segment_paths
from agent.segments import About, Received
from agent.service import Service
from agent.version import handfast_version

POLL_S: Final = 0.05
INBOX: Final = 16_384
"""A minute of one robot: for so long a disk may stall and nothing is lost."""
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
        from agent.formation import resolved

        fleet = resolved(fleet)
    try:
        boot = _BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        boot = ""
    return About(fleet.fleet.name, digest(fleet), robot, handfast_version(), boot, 0, 0, fleet_toml)


def known(path: Path, orders: frozenset[str]) -> list[Received]:
    """The orders that the newest segment of a folder tells of; none where there is none that can be read."""
    try:
        return [each for newest in segment_paths(path)[-1:] for each in known_orders(newest, orders)]
    except OSError:
        return []


def record(bus: Bus, recorder: RobotRecorder, shutdown: Shutdown, service: Service) -> None:
    """Records what comes until the process is asked to end."""
    clock = _WallClock()
    while not shutdown.asked:
        time.sleep(POLL_S)
        now_ns = clock.now_ns()
        _take(bus, recorder, now_ns)
        if step_ns := clock.stepped_ns():
            recorder.flush(now_ns)
            recorder.set_clock(step_ns / NS_PER_S)
        else:
            recorder.flush_if_due(now_ns)
        service.lives(time.monotonic_ns())
        shutdown.look_for_parent()
    service.stopping()
    now_ns = clock.now_ns()
    _take(bus, recorder, now_ns)
    recorder.flush(now_ns)


def _take(bus: Bus, recorder: RobotRecorder, now_ns: int) -> None:
    count = 0
    for count, (key, payload) in enumerate(bus.drain(), 1):  # noqa: B007 - counts what came
        recorder.add(now_ns, key, payload)
    if count >= INBOX:
        recorder.overflow()


def _open(path: Path, bytes_max: int, shutdown: Shutdown, service: Service, log: Log) -> SegmentFolder | None:
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
            service.lives(time.monotonic_ns())
            shutdown.look_for_parent()
    return None


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process. Returns its exit status: 0 when it was asked to end, 1 when it cannot begin now, 2
    for bad input."""
    parser = robot_arguments("python -m agent.recorder_process", "Records what one robot of a fleet says.")
    parser.add_argument("--folder", required=True, type=Path, metavar="DIR", help="where the recording goes")
    options = parser.parse_args(argv)
    shutdown = Shutdown(with_parent=options.exit_with_parent)
    robot, path = options.robot, options.folder
    log = logger(robot, "recorder")
    try:
        fleet = load_fleet(options.fleet)
        endpoints = [fleet.agent_endpoint(robot), fleet.plant_endpoint(robot)]
        told = about(fleet, read_text(options.fleet, "fleet file"), robot)
        with Service() as service:
            service.ready()  # it does its work: a disk that is full must not look like a start that fails
            folder = _open(path, fleet.recording.max_mb * 1_000_000, shutdown, service, log)
            if folder is None:
                return 0
            with (
                folder,
                open_bus(
                    fleet, robot, options.keys, log, listen=[], connect=endpoints, through_routers=False
                ) as bus,
            ):
                os.nice(NICE)
                bus.subscribe(keys.everything(fleet.fleet.name), INBOX)
                log(f"recording into {path}, at most {fleet.recording.max_mb} MB")
                orders = order_keys(told.fleet, robot)
                recorder = RobotRecorder(folder, told, orders, known(path, orders), log)
                record(bus, recorder, shutdown, service)
                log(f"ending ({shutdown.why})")
    except (FleetError, StartError) as error:
        log(str(error))
        return BAD_INPUT
    except (BusError, FolderInUseError) as error:
        log(str(error))
        return FAILED
    except OSError as error:
        log(f"cannot record into {path}: {error.strerror or type(error).__name__}")
        return BAD_INPUT
    return 0


if __name__ == "__main__":
    sys.exit(main())
