"""Reads parameters of rovers, sets them and reads them back: `handfast preflight --set-parameters`.

ArduPilot answers PARAM_SET with the value that it has then, and not at all where it has no such parameter:
what counts is what it says when it is asked again.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from math import isclose
from typing import Any, Final, NamedTuple

from agent.common.time import NS_PER_S, Clock
from agent.fleet.mavlink_section import SIMULATOR, MavlinkSection
from agent.fleet.model import Fleet
from bridges.mavlink.session.session import Session
from bridges.mavlink.session.settings import SessionSettings, session_settings
from bridges.mavlink.session.signing import SigningError, open_signing
from bridges.mavlink.transport.transport import Transport, open_transport

PERIOD_NS: Final = NS_PER_S // 25
VEHICLE_NS: Final = 15 * NS_PER_S
"""A vehicle must have been heard by then; it sends a heartbeat once a second."""
LISTEN_NS: Final = 2 * NS_PER_S
"""So long all that is on the link is listened to before anything is set."""
READ_NS: Final = 15 * NS_PER_S
"""A dozen parameters over a radio that loses every third message take half of this."""
SET_AGAIN_NS: Final = NS_PER_S
SET_MAX: Final = 4
LOST: Final = "was sent, and the vehicle was not heard after that: it may have it or not"
UNREAD: Final = "was sent and not read back: it may have it or not"


def same(one: float, other: float) -> bool:
    """Whether two values of a parameter are the same: a vehicle keeps them with 24 bits."""
    return isclose(one, other, rel_tol=1e-6, abs_tol=1e-9)


class Task(NamedTuple):
    """What to do with one vehicle.

    Attributes:
        names: parameters to read.
        wanted: of these, those to set: the value that it must have before, and the one to set.
        system: its system id, where it must be one that was met before; None: any.
    """

    names: tuple[str, ...]
    wanted: Mapping[str, tuple[float, float]] = {}
    system: int | None = None


class Answer(NamedTuple):
    """What became of it.

    Attributes:
        trouble: why nothing was done, "" where something was.
        system: the vehicle's system id.
        values: what it says at the end, by name; None for a parameter that it does not tell, or has not told
            since that was sent.
        lacking: by name, why one that was to be set is not, or is not known to be.
    """

    trouble: str
    system: int | None = None
    values: Mapping[str, float | None] = {}
    lacking: Mapping[str, str] = {}


class ParameterSetup:
    """Carries a task out on the vehicle behind `transport`, unless it is armed or no rover.

    Args:
        settings: `bridges.mavlink.session.settings.session_settings`.

    Attributes:
        answer: None while it is not known.
    """

    def __init__(self, settings: SessionSettings, transport: Transport, task: Task) -> None:
        self.answer: Answer | None = None
        self._task, self._transport = task, transport
        self._link = Session(settings)
        self._transport_epoch, self._link_epoch = transport.epoch, self._link.epoch
        self._begun_ns: int | None = None
        self._heard_ns: int | None = None
        self._phase_ns: int | None = None
        self._lacking: dict[str, str] = {}
        self._to_set: list[str] = []
        self._sent: list[str] = []
        self._reads_back = False
        self._tries, self._sent_ns = 0, 0
        self._steps: Iterator[None] | None = None
        self._now_ns = 0

    def step(self, now_ns: int) -> None:
        """Takes what came and sends what is due; called at 10 Hz at least until there is an answer."""
        self._now_ns = now_ns
        if self._begun_ns is None:
            self._begun_ns = now_ns
        link = self._link
        if self._transport_epoch != self._transport.epoch:
            self._transport_epoch = self._transport.epoch
            self._heard_ns = None
            link.restart()
        for arrival_ns, data in self._transport.receive():
            link.receive(arrival_ns, data)
        if link.connected(now_ns) and self._heard_ns is None:
            self._heard_ns = now_ns
        if self._steps is None:
            self._steps = self._carried_out()
        next(self._steps, None)
        if out := link.tick(now_ns):
            self._transport.send(out)

    def interrupted(self) -> Answer:
        """What is known when it is ended before there is an answer."""
        if not self._sent:
            return Answer("interrupted: nothing was set" if self._task.wanted else "interrupted")
        return self._ended(UNREAD)

    # ------------------------------------------------------------------ what is done, step by step

    def _carried_out(self) -> Iterator[None]:
        """Ends with `answer`; waits where it yields."""
        yield from self._met()
        if self.answer is not None:
            return
        yield from self._read()
        told = self._link.parameters
        if not any(told.get(name) is not None for name in self._task.names):
            self._fail("it tells none of its parameters: see what `handfast preflight` says of it")
            return
        if self._task.wanted:
            self._look_again()
            self._link_epoch = self._link.epoch
            yield from self._set()
            self._link.read_parameters()
            self._reads_back = True
            yield from self._read()
        self.answer = self._ended(LOST)

    def _met(self) -> Iterator[None]:
        """Waits for the vehicle; `answer` says why it is not to be set."""
        link = self._link
        assert self._begun_ns is not None
        while self._heard_ns is None or self._now_ns - self._heard_ns < LISTEN_NS:
            if not link.connected(self._now_ns) and self._now_ns - self._begun_ns >= VEHICLE_NS:
                self._fail(self._transport.trouble or link.absence(self._now_ns))
                return
            if link.connected(self._now_ns) and link.problem:
                self._fail(f"it {link.problem}")
                return
            yield
        if link.settings.system is None and link.strangers:
            systems = ", ".join(map(str, sorted({link.system or 0, *link.strangers})))
            self._fail(f"systems {systems} are on this link: say which is meant, with mavlink.system")
        elif self._task.system not in (None, link.system):
            self._fail(
                f"it is system {link.system}, and its old values are those of system {self._task.system}: "
                "another vehicle"
            )
        elif link.armed:
            self._fail("it is armed: disarm it first")

    def _fail(self, trouble: str) -> None:
        self.answer = Answer(trouble, self._link.system)

    def _read(self) -> Iterator[None]:
        """Waits until the vehicle has told its parameters, or does not."""
        until_ns = self._now_ns + READ_NS
        while not self._link.parameters_done and self._now_ns < until_ns:
            yield

    def _look_again(self) -> None:
        """Leaves alone what is not as it was when somebody agreed to change it."""
        for name, (before, _) in self._task.wanted.items():
            value = self._link.parameters.get(name)
            if value is None:
                self._lacking[name] = "is not told any more: left alone"
            elif not same(value, before):
                self._lacking[name] = f"is {value:g} by now, not {before:g}: left alone"
            else:
                self._to_set.append(name)

    def _set(self) -> Iterator[None]:
        """Sends each until the vehicle says that it has it, a few times at most."""
        link = self._link
        for name in self._to_set:
            value = self._task.wanted[name][1]
            for _ in range(SET_MAX):
                if why := self._why_not():
                    if name not in self._sent:
                        self._lacking[name] = why
                    break
                if data := link.set_parameter(name, value):
                    if name not in self._sent:
                        self._sent.append(name)
                    self._transport.send(data)
                until_ns = self._now_ns + SET_AGAIN_NS
                while self._now_ns < until_ns and not self._has(name, value):
                    yield
                if self._has(name, value):
                    break

    def _why_not(self) -> str:
        """Why nothing more is set, "" when it is."""
        link = self._link
        if link.armed:
            return "was not set: it was armed meanwhile"
        if link.epoch != self._link_epoch:
            return "was not set: the link was lost, or the vehicle started again"
        return "" if link.connected(self._now_ns) else f"was not set: {link.absence(self._now_ns)}"

    def _has(self, name: str, value: float) -> bool:
        told = self._link.parameters.get(name)
        return told is not None and same(told, value)

    def _ended(self, unheard: str) -> Answer:
        """The answer, from what the vehicle says now.

        Before all are read back, the value that one had before it was sent may be the one from then, and
        tells nothing; any other has come since.

        Args:
            unheard: what to say of one that was sent and of which it has said nothing since.
        """
        lacking = dict(self._lacking)
        values = {name: self._link.parameters.get(name) for name in self._task.names}
        for name in self._sent:
            value, (before, wanted) = values[name], self._task.wanted[name]
            if value is not None and not self._reads_back and same(value, before):
                value = values[name] = None
            if value is None:
                lacking[name] = unheard
            elif not same(value, wanted):
                lacking[name] = f"was sent, and it keeps {value:g}"
        for name in self._task.wanted:
            if name not in self._sent:
                lacking.setdefault(name, "was not set")
        return Answer("", self._link.system, values, lacking)


def carry_out(
    fleet: Fleet, tasks: Mapping[int, Task], clock: Clock, interrupted: Callable[[], bool]
) -> dict[int, Answer]:
    """Carries tasks out, by robot, side by side, until all have ended or it is interrupted."""
    answers: dict[int, Answer] = {}
    with ExitStack() as stack:
        setups: dict[int, ParameterSetup] = {}
        for robot, task in tasks.items():
            try:
                setups[robot] = _open(fleet, robot, task, clock, stack)
            except (SigningError, ValueError) as error:
                answers[robot] = Answer(str(error))
        waiting = dict(setups)
        while waiting and not interrupted():
            now_ns = clock.now_ns()
            for robot, setup in list(waiting.items()):
                setup.step(now_ns)
                if setup.answer is not None:
                    del waiting[robot]
            clock.sleep_until(now_ns + PERIOD_NS)
        for robot, setup in setups.items():
            answers[robot] = setup.answer or setup.interrupted()
    return {robot: answers[robot] for robot in tasks}


def _open(fleet: Fleet, robot: int, task: Task, clock: Clock, stack: ExitStack) -> ParameterSetup:
    """Raises `SigningError`, `ValueError`: it cannot be reached as the fleet file says."""
    section = fleet.robot(robot).section(MavlinkSection)
    if section is None or section.connection in (None, SIMULATOR):
        raise ValueError("the fleet file names no vehicle that can be reached")
    assert section.connection is not None
    signing = None
    if section.signing_key is not None:
        signing = open_signing(fleet.fleet.name, robot, section.signing_key, clock.now_ns())
        stack.callback(signing.timestamps.close)
    settings = session_settings(section, secrets.randbits(32), signing=signing, parameters=task.names)
    transport = open_transport(section.connection, section.baud, clock.now_ns, section.system)
    stack.callback(transport.close)
    return ParameterSetup(settings, transport, task)


def tasks_to_json(tasks: Mapping[int, Task]) -> dict[str, Any]:
    """Tasks as JSON values, by robot."""
    return {
        str(robot): {"names": list(task.names), "wanted": dict(task.wanted), "system": task.system}
        for robot, task in tasks.items()
    }


def tasks_of(values: Any) -> dict[int, Task]:
    """The tasks in what `tasks_to_json` wrote; raises ValueError, TypeError, LookupError for another."""
    return {
        int(robot): Task(
            tuple(map(str, row["names"])),
            {str(name): (float(before), float(value)) for name, (before, value) in row["wanted"].items()},
            None if row["system"] is None else int(row["system"]),
        )
        for robot, row in values.items()
    }


def answers_of(values: Any) -> dict[int, Answer]:
    """The answers in JSON values of `Answer._asdict`, by robot; raises as `tasks_of`."""
    return {
        int(robot): Answer(
            str(row["trouble"]),
            None if row["system"] is None else int(row["system"]),
            {str(name): None if value is None else float(value) for name, value in row["values"].items()},
            {str(name): str(why) for name, why in row["lacking"].items()},
        )
        for robot, row in values.items()
    }
