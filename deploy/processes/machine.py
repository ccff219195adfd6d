"""What this machine has to give to robots' processes: how many processors, and how fast one is."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from math import dist, inf
from pathlib import Path
from statistics import median
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import PlantState
from handfast.deploy.check.capacity import Machine, is_looked_at, is_refused, overload

WINDOWS: Final = 6
ROUNDS: Final = 20
MESSAGES: Final = 150
LOOKS: Final = 3
PAUSE_S: Final = 1.0
"""So many looks are taken at most, with a pause between them."""
ROUND_S: Final = 1.08e-3
"""Processor time of one round of `_work` where the costs of `deploy.check.capacity` were measured."""
BUSY: Final = (
    "import os, sys\nos.sched_setaffinity(0, {int(sys.argv[1])})\nos.write(1, b'.')\n"
    "while os.getppid() == int(sys.argv[2]):\n for _ in range(100_000): pass"
)
"""It ends with its parent, however that does."""
_CPUS: Final = Path("/sys/devices/system/cpu")
_CGROUPS: Final = Path("/sys/fs/cgroup")
_OWN_CGROUP: Final = Path("/proc/self/cgroup")


def measured() -> Machine:
    """This machine, by some 0.2 s of work of the kind that robots do, beside another program that is busy:
    two processors that are threads of one core are not twice as fast as one.

    The fastest window counts. On a host with other tenants, windows of one look are of two kinds: as fast as
    ever, or 0.6 times that, mostly while nothing else runs here (two processors then are threads of one core,
    as it looks; where there is work, as when a fleet drives, all are fast). A mean tells how many were slow,
    which is luck: of two that were taken within two minutes, one in ten differed by 1.26 times or more, up to
    1.66. Of the fastest windows it was 1.06 times.
    """
    allowed = sorted(os.sched_getaffinity(0))
    took_s = min(_took_s(allowed[number % len(allowed)], allowed) for number in range(WINDOWS))
    return Machine(cores(), ROUND_S / took_s)


def measured_for(fleet: Fleet) -> Machine:
    """This machine, which is looked at again where it would carry no such fleet: in one look of twenty all
    windows were slow, a second later some were not, and the fastest of three looks were the same within 1.09
    times. A fleet that is carried waits for no second look. Nothing is kept from command to command: a file
    would have to know when a machine has become another, as one that was moved or given fewer processors."""
    found = measured()
    for _ in range(LOOKS - 1):
        if not is_refused(fleet, found):
            break
        time.sleep(PAUSE_S)
        found = max(found, measured(), key=lambda machine: machine.speed)
    return found


def _took_s(here: int, allowed: Collection[int]) -> float:
    """Processor time of one round of `_work` on a processor, s."""
    others = [cpu for cpu in allowed if cpu != here]
    there = [cpu for cpu in _siblings(_CPUS, here) if cpu in others] or others
    with ExitStack() as stack:
        if there:
            stack.enter_context(_busy(there[0]))
            os.sched_setaffinity(0, {here})
            stack.callback(os.sched_setaffinity, 0, allowed)
        return median(_work() for _ in range(ROUNDS))


@contextmanager
def _busy(cpu: int) -> Iterator[None]:
    """A program that takes a processor."""
    words = [sys.executable, "-I", "-S", "-c", BUSY, str(cpu), str(os.getpid())]
    # In a process group of its own: a Ctrl-C is for this one.
    with subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, process_group=0
    ) as program:
        try:
            assert program.stdout is not None
            program.stdout.read(1)
            yield
        finally:
            program.kill()


def _siblings(cpus: Path, cpu: int) -> list[int]:
    """The other processors of the same core, as far as this machine tells."""
    with suppress(OSError, ValueError):
        found: list[int] = []
        for part in (cpus / f"cpu{cpu}/topology/thread_siblings_list").read_text().strip().split(","):
            first, _, last = part.partition("-")
            found += range(int(first), int(last or first) + 1)
        return [each for each in found if each != cpu]
    return []


def overload_here(fleet: Fleet) -> str:
    """Why this machine does not carry `fleet` as processes, "" where it does; small ones cost nothing."""
    return overload(fleet, measured_for(fleet)) if is_looked_at(fleet) else ""


def cores() -> float:
    """How many processors this process may use: those that it may run on, and no more than its control group
    is given."""
    return min(float(len(os.sched_getaffinity(0))), _quota(_CGROUPS, _OWN_CGROUP))


def _quota(cgroups: Path, own: Path) -> float:
    """Processors that the control group of this process is given, or one that it is in; inf for no limit."""
    least = inf
    with suppress(OSError, ValueError):
        for line in own.read_text().splitlines():
            number, _, path = line.partition("::")
            if number != "0":
                continue
            folder = cgroups / path.lstrip("/")
            for each in (folder, *folder.parents):
                with suppress(OSError, ValueError):
                    quota, period = (each / "cpu.max").read_text().split()
                    if quota != "max":
                        least = min(least, int(quota) / int(period))
                if each == cgroups:
                    break
    return least


def _work() -> float:
    """Messages written, read and looked at as an agent does; the processor time that it took, s."""
    begun = time.thread_time()
    near = 0
    for number in range(MESSAGES):
        x, y = 0.01 * number, 1.0 - 0.01 * number
        sent = PlantState(1, number, number, x, y, 0.1, 0.1, 0.1, 0.1, 0.1, False, True, True, "")
        came = decode(encode(sent))
        if type(came) is PlantState:
            near += sum(dist((came.x, came.y), (0.1 * k, 0.0)) < 1.5 for k in range(20))
    assert near
    return time.thread_time() - begun
