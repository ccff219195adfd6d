"""What a process has been granted of real time, by looking at it (Linux), and how that is said.

Whoever asked is not trusted to know: a sandbox, a limit or an overrun may have taken it away again.
``python -m handfast.agent.runtime.realtime_granted PID ...`` prints what processes have, for who looks over
ssh: JSON, an object for each, null for one that is not there.
"""

from __future__ import annotations

import json
import os
import pwd
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from handfast.agent.fleet.hosts import PRIORITIES, ProcessSection

PRIORITY_MAX: Final = 99
SCHED_FIFO: Final = 1
POLICIES: Final = {
    0: "SCHED_OTHER", SCHED_FIFO: "SCHED_FIFO", 2: "SCHED_RR", 3: "SCHED_BATCH", 5: "SCHED_IDLE",
    6: "SCHED_DEADLINE",
}  # fmt: skip
"""Scheduling policies by Linux's numbers, of which `os` has not all."""
LIMITS: Final = {"rtprio": "Max realtime priority", "memlock": "Max locked memory"}
"""Limits as /proc/PID/limits names them: those of other processes cannot be asked for by getrlimit(2)."""
CAP_IPC_LOCK: Final = 14
CAP_SYS_NICE: Final = 23
ONLINE: Final = Path("/sys/devices/system/cpu/online")
OVERRUN_S: Final = 0.5
"""A thread that runs for so long without waiting once has its process give up real time."""
KILLED_S: Final = 3.0
"""And one that does so for this long, in code that hears no signal, is killed by the kernel."""
IN_UNITS: Final = (
    "there, as root: in /etc/systemd/system/user@.service.d/handfast.conf [Service] LimitRTPRIO={priority} "
    "and LimitMEMLOCK=infinity, then restart that computer"
)
IN_LOGINS: Final = (
    "as root: `{user} - rtprio {priority}` and `{user} - memlock unlimited` in "
    "/etc/security/limits.d/handfast.conf, then log in anew"
)


class Thread(NamedTuple):
    """How the kernel schedules one thread, sched(7).

    Attributes:
        number, name: as the kernel has them.
        policy: `SCHED_FIFO` or another one.
        priority: 1 to 99 under SCHED_FIFO and SCHED_RR.
        cpus: cores on which it may run.
    """

    number: int
    name: str
    policy: int
    priority: int
    cpus: tuple[int, ...]

    @property
    def scheduling(self) -> str:
        """Its policy and what priority it has there, as 'SCHED_FIFO 41'."""
        policy = POLICIES.get(self.policy, f"scheduling policy {self.policy}")
        return f"{policy} {self.priority}" if self.priority else policy


class Granted(NamedTuple):
    """What a process has.

    Attributes:
        fifo: the SCHED_FIFO priority of its main thread; 0 under any other policy.
        cpus: cores on which that may run.
        there: cores of the computer.
        locked: whether memory of it is locked.
        rtprio: the highest priority that it might ask for (RLIMIT_RTPRIO).
        memlock: how much memory it might lock, bytes (RLIMIT_MEMLOCK); -1: any.
        privileged: it has CAP_SYS_NICE, so that its limit does not count.
        threads: all of its threads, the main one first.
    """

    fifo: int
    cpus: tuple[int, ...]
    there: tuple[int, ...]
    locked: bool
    rtprio: int
    memlock: int
    privileged: bool
    threads: tuple[Thread, ...] = ()


class Said(NamedTuple):
    """What was found in words, and what to do about it ("" where all was granted that was asked for)."""

    found: str
    advice: str

    def __str__(self) -> str:
        return f"{self.found} ({self.advice})" if self.advice else self.found


def look(pid: int) -> Granted | None:
    """What a process has, by its number; None where it is gone, or this is no Linux."""
    with suppress(OSError, ValueError, LookupError, AttributeError):
        status = _fields(f"/proc/{pid}/status")
        limits = Path(f"/proc/{pid}/limits").read_text()
        main, others = _thread(pid, pid), _threads(pid)
        return Granted(
            fifo=main.priority if main.policy == SCHED_FIFO else 0,
            cpus=main.cpus,
            there=cpu_list(ONLINE.read_text()),
            locked=int(status["VmLck"].split()[0]) > 0,
            rtprio=_limit(limits, LIMITS["rtprio"], PRIORITY_MAX),
            memlock=_limit(limits, LIMITS["memlock"], -1),
            privileged=_has(status, CAP_SYS_NICE),
            threads=(main, *others),
        )
    return None


def _threads(pid: int) -> Iterator[Thread]:
    """Those of a process but its main one."""
    for number in sorted(map(int, os.listdir(f"/proc/{pid}/task"))):
        if number != pid:
            with suppress(OSError):  # it has ended
                yield _thread(pid, number)


def _thread(pid: int, number: int) -> Thread:
    return Thread(
        number,
        Path(f"/proc/{pid}/task/{number}/comm").read_text().rstrip("\n"),
        os.sched_getscheduler(number) & ~os.SCHED_RESET_ON_FORK,
        os.sched_getparam(number).sched_priority,
        tuple(sorted(os.sched_getaffinity(number))),
    )


def is_capable(capability: int) -> bool:
    """Whether this process has a capability, capabilities(7)."""
    with suppress(OSError, ValueError, LookupError):
        return _has(_fields("/proc/self/status"), capability)
    return False


def _has(status: Mapping[str, str], capability: int) -> bool:
    return bool(int(status["CapEff"], 16) >> capability & 1)


def _fields(path: str) -> dict[str, str]:
    return dict(line.split(":", 1) for line in Path(path).read_text().splitlines())


def _limit(text: str, name: str, unlimited: int) -> int:
    """The hard limit of that name: a process may raise its own to it."""
    (line,) = (line for line in text.splitlines() if line.startswith(name))
    hard = line[len(name) :].split()[1]
    return unlimited if hard == "unlimited" else int(hard)


def cpu_list(text: str) -> tuple[int, ...]:
    """Reads the kernel's list of cores, such as ``0-3,6``. `ValueError`: it is none."""
    found: list[int] = []
    for part in text.strip().split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return tuple(found)


def cores(cpus: Sequence[int]) -> str:
    """'core 2', or 'cores 0-3, 6'."""
    parts: list[list[int]] = []
    for cpu in sorted(set(cpus)):
        if parts and cpu == parts[-1][-1] + 1:
            parts[-1].append(cpu)
        else:
            parts.append([cpu])
    shown = ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)
    return f"core{'s' * (len(set(cpus)) != 1)} {shown}"


def said(section: ProcessSection, role: str, granted: Granted | None, *, as_unit: bool) -> Said:
    """What an ``agent`` or ``plant`` has been granted of what the fleet file asks for.

    Args:
        granted: what was found, None where nothing was.
        as_unit: whether systemd started it, whose limits count then.
    """
    if granted is None:
        return Said("cannot be looked at", "only Linux has it; there, its log says why it is gone")
    has = [f"SCHED_FIFO {granted.fifo}"] if granted.fifo else []
    has += [cores(granted.cpus)] + ["memory locked"] * granted.locked
    lacks = list(_lacks(section, role, granted))
    if not lacks:
        return Said(", ".join(has), "")
    advice = list(dict.fromkeys(each for _, each in lacks))
    names = {"priority": PRIORITIES["plant"], "user": _user()}
    limits = (IN_UNITS if as_unit else IN_LOGINS).format(**names)
    return Said(
        "; ".join([", ".join(has), *(each for each, _ in lacks)]),
        "; ".join(limits if each is None else each for each in advice),
    )


def _lacks(section: ProcessSection, role: str, granted: Granted) -> Iterator[tuple[str, str | None]]:
    """What was not granted and what to do about it; None for that: raise its limits."""
    if granted.fifo < PRIORITIES[role]:
        if granted.rtprio < PRIORITIES["plant"] and not granted.privileged:
            needed = f"{PRIORITIES['plant']} is needed"
            yield f"SCHED_FIFO refused: RLIMIT_RTPRIO is {granted.rtprio}, {needed}", None
        else:
            yield (
                "SCHED_FIFO refused or given up",
                "its limits allow it: see its log; a container or another sandbox may forbid it, or its "
                "control group have none (cpu.rt_runtime_us)",
            )
    if not granted.locked:
        if granted.memlock >= 0:
            limit = f"{granted.memlock // 1024} kB"
            yield f"memory not locked: RLIMIT_MEMLOCK is {limit}, it has to be unlimited", None
        else:
            yield "memory not locked", "see its log: a container or another sandbox may forbid it"
    missing = set(section.cpus) - set(granted.cpus)
    if absent := sorted(missing - set(granted.there)):
        yield f"not on {cores(absent)}", f"correct process.cpus: there are {cores(granted.there)}"
    if closed := sorted(missing & set(granted.there)):
        yield (
            f"not on {cores(closed)}",
            "a container or control group keeps it from there (cpuset.cpus)",
        )
    if section.cpus and not missing and (others := sorted(set(granted.cpus) - set(section.cpus))):
        yield f"on {cores(others)} as well", "something else has set its cores: see `taskset -p`"


def _user() -> str:
    """Name of who runs this process, as limits.conf(5) wants it."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return "USER"


def from_json(value: Any) -> Granted | None:
    """What `main` printed of one process.

    Raises:
        ValueError: it makes no sense.
    """
    if value is None:
        return None
    try:
        fifo, cpus, there, locked, rtprio, memlock, privileged = (
            value[name] for name in Granted._fields[:-1]
        )
        return Granted(
            int(fifo),
            tuple(map(int, cpus)),
            tuple(map(int, there)),
            bool(locked),
            int(rtprio),
            int(memlock),
            bool(privileged),
            tuple(
                Thread(int(number), str(name), int(policy), int(priority), tuple(map(int, on)))
                for number, name, policy, priority, on in value.get("threads", ())  # a host may have less
            ),
        )
    except (TypeError, LookupError) as error:
        raise ValueError(f"no answer about real time: {type(error).__name__}") from None


def to_json(granted: Granted | None) -> str:
    """One of what `main` prints."""
    return json.dumps(None if granted is None else granted._asdict())


def main(argv: Sequence[str]) -> int:
    """Prints what processes have been granted, one on a line."""
    for pid in argv:
        print(to_json(look(int(pid))))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
