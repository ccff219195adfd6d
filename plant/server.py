"""Hosts any `PlantBackend` on the bus as a process, and keeps the pose of a simulated body in a file.

A real body stays where it is when the process that drives it dies. So does a simulated one, however its
process ended: the file is mapped memory, which the kernel keeps.
"""

from __future__ import annotations

import argparse
import errno
import mmap
import os
import socket
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from struct import Struct
from typing import Final

from handfast.agent.common.time import Clock
from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.links.ticks import Ticks, plant_slot_ns
from handfast.agent.recorder.folder import PASSING
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import Start, StartError, log_name, logger
from handfast.agent.runtime.process import main as process_main
from handfast.agent.transport.bus import BusError
from handfast.plant.backend import Check, Command, Place, PlantBackend, Reading
from handfast.plant.node import PlantNode
from handfast.plant.pool import PlantPool, PoolTicks


def main(
    argv: Sequence[str] | None,
    program: str,
    make: Callable[[Fleet, int, Clock, Log], PlantBackend],
    beside: Sequence[int] = (),
    logs: Path | None = None,
    own: Sequence[argparse.ArgumentParser] = (),
) -> int:
    """Command line of a plant process. Returns the exit status.

    Args:
        argv: after the program's name; None: that of this process.
        program: its name, for messages.
        make: the backend of a robot, from its fleet, its id, the process's clock and what writes a line of
            its log.
        beside: robots whose plants the process serves, too. Others hear them through the fleet's routers:
            it listens nowhere.
        logs: folder of these plants' logs, each in a file of its own; None: in that of the process.
        own: have the program's own options, for its help.
    """

    def start(fleet: Fleet, robot: int, clock: Clock, log: Log) -> Start:
        if not fleet.is_resolved:  # else without numpy, which takes its time
            from handfast.agent.formation.geometry import resolved

            fleet = resolved(fleet)
        if beside:
            return _several(fleet, [robot, *beside], clock, log)
        backend = make(fleet, robot, clock, log)
        node = PlantNode(fleet, robot, backend)
        ticks_from = partial(Ticks, node, slot_ns=plant_slot_ns(fleet, robot))
        return Start(node, fleet.plant_listens(robot), [fleet.agent_near(robot)], ticks_from, backend.close)

    def _several(fleet: Fleet, robots: Sequence[int], clock: Clock, log: Log) -> Start:
        if not fleet.routers:
            raise StartError(
                "--with: the plants of several robots share a process only behind a router, and this file "
                "names none (network.routers)"
            )
        for robot in robots:
            fleet.robot(robot)  # says which are there
            if robots.count(robot) > 1:
                raise StartError(f"--with: robot {robot} is named twice")
        if logs is not None and not logs.is_dir():
            raise StartError(f"--logs: there is no folder {logs}")
        held = held_ports(fleet, robots)
        writing = [log, *(logger(f"robot {robot}", "plant", _log_of(robot)) for robot in robots[1:])]
        backends = [make(fleet, robot, clock, log) for robot, log in zip(robots, writing, strict=True)]
        nodes = [PlantNode(fleet, *each) for each in zip(robots, backends, strict=True)]
        pool = PlantPool(nodes, writing)

        def close() -> None:
            for backend in backends:
                backend.close()
            for port in held:
                port.close()

        agents = [fleet.agent_near(robot) for robot in robots]
        ticks_from = partial(PoolTicks, pool, slot_ns=plant_slot_ns(fleet, robots[0]))
        return Start(pool, (), agents, ticks_from, close, robots[1:])

    def _log_of(robot: int) -> Path | None:
        return None if logs is None else logs / log_name(robot, "plant")

    return process_main(argv, program, "plant", start, own)


def held_ports(fleet: Fleet, robots: Sequence[int]) -> list[socket.socket]:
    """Has the ports on which the plants of `robots` would listen in processes of their own, so that nobody
    starts a second body of one of them on this machine.

    Raises:
        BusError: somebody has one of them.
    """
    held: list[socket.socket] = []
    for robot in robots:
        for endpoint in fleet.plant_listens(robot):
            address, _, port = endpoint.partition("/")[2].rpartition(":")
            taken = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET)
            held.append(taken)
            taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # links of an earlier run may linger
            try:
                taken.bind((address.strip("[]"), int(port)))
                taken.listen(0)  # else others may listen there
            except OSError as error:
                for each in held:
                    each.close()
                raise BusError(
                    f"robot {robot}'s plant cannot have {endpoint}: {error.strerror}; is there one already?"
                ) from None
    return held


_PLACE: Final = Struct("<Qddd")  # number of the record; x, y (m, W), heading (rad)
_CHECKSUM: Final = Struct("<I")
_SLOT: Final = _PLACE.size + _CHECKSUM.size


class PoseFileError(RuntimeError):
    """The file cannot be used; the text is one clear line.

    Attributes:
        transient: whether it may be usable later, as one on a disk that is full.
    """

    def __init__(self, text: str, *, transient: bool) -> None:
        super().__init__(text)
        self.transient = transient


class PoseFile:
    """The pose file at `path`, made if need be.

    Two records take turns, each with its number and a CRC-32, so that one is whole whenever the process dies.

    Attributes:
        place: where the body was last, None when it is not known.

    Raises:
        PoseFileError: it cannot be opened or made.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                _allocate(handle)
                self._memory = mmap.mmap(handle, 2 * _SLOT)
            finally:
                os.close(handle)
        except OSError as error:
            text = f"cannot use the pose file {path}: {error.strerror or error}"
            raise PoseFileError(text, transient=error.errno in PASSING) from None
        found = [record for slot in (0, 1) if (record := self._read(slot)) is not None]
        self._number = max((number for number, _ in found), default=0)
        self.place: Place | None = dict(found).get(self._number)

    def _read(self, slot: int) -> tuple[int, Place] | None:
        record = self._memory[slot * _SLOT : (slot + 1) * _SLOT]
        packed = record[: _PLACE.size]
        number, *place = _PLACE.unpack(packed)
        whole = _CHECKSUM.unpack(record[_PLACE.size :])[0] == zlib.crc32(packed)
        if not whole or number == 0 or not all(map(isfinite, place)):
            return None
        return number, (place[0], place[1], place[2])

    def write(self, pose: Pose) -> None:
        """Records where the body is now, with `pose` in W. Two stores to memory: it never waits."""
        self._number += 1
        packed = _PLACE.pack(self._number, pose.x, pose.y, pose.heading)
        start = self._number % 2 * _SLOT
        self._memory[start : start + _SLOT] = packed + _CHECKSUM.pack(zlib.crc32(packed))

    def close(self) -> None:
        """Unmaps the file, which stays."""
        self._memory.close()


def _allocate(handle: int) -> None:
    """Has the disk set aside what the file takes: a full one would kill us at a write to mapped memory.

    Raises:
        OSError: there is no room for it.
    """
    there = os.pread(handle, 2 * _SLOT, 0)
    if os.pwrite(handle, there.ljust(2 * _SLOT, b"\0"), 0) < 2 * _SLOT:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    os.ftruncate(handle, 2 * _SLOT)


class PersistentBody(PlantBackend):
    """A body whose place is written to `pose_file` at every step. It closes both."""

    def __init__(self, body: PlantBackend, pose_file: PoseFile) -> None:
        self._body, self._pose_file = body, pose_file

    def step(self, now_ns: int, command: Command | None) -> Reading:
        reading = self._body.step(now_ns, command)
        self._pose_file.write(reading.pose)
        return reading

    def clear_to_drive(self) -> None:
        self._body.clear_to_drive()

    def checks(self, now_ns: int) -> Sequence[Check]:
        return self._body.checks(now_ns)

    def close(self) -> None:
        self._body.close()
        self._pose_file.close()
