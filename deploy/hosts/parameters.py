"""Reads and sets parameters of vehicles on the hosts that they are joined to: the same program as on one
machine runs there, over ssh, in place of the bridges."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Final

from agent.common.wording import printable
from agent.fleet.model import Fleet
from bridges.mavlink.bridge import parameter_program
from bridges.mavlink.bridge.parameter_setup import Answer, Task, answers_of, tasks_to_json
from deploy.console.interrupt import Interrupt
from deploy.console.wording import robots as robots_words
from deploy.hosts import remote_vehicle
from deploy.hosts.at_rest import rest_of
from deploy.hosts.connection import HostConnection, HostError
from deploy.hosts.jobs import HostJobs
from deploy.hosts.view import Row

WITHIN_S: Final = 120.0
"""The program ends by itself before that: 15 s for the vehicle, 15 s to read, 4 s for each parameter."""
MORE_S: Final = 45.0
"""A bridge ends within 5 s, and starts again."""
LOOK_S: Final = 0.05


def refusal(fleet: Fleet, file: str) -> str:
    """Why the bridges of a fleet cannot be stopped for a while now, "" when they can."""
    on_mission = rest_of(fleet, file).on_mission
    if not on_mission:
        return ""
    are = "are" if len(on_mission) > 1 else "is"
    return f"{robots_words(on_mission)} {are} on a mission: `handfast stop {file}` first"


def carry_out_on_hosts(
    fleet: Fleet, tasks: Mapping[int, Task], file: str, interrupt: Interrupt
) -> dict[int, Answer]:
    """Carries tasks out, by robot, all hosts side by side.

    Args:
        fleet: resolved and located.
        file: the fleet's, as it is named in commands.
    """
    answers: dict[int, Answer] = {}
    names = {fleet.robot(robot).host for robot in tasks}

    def work(connection: HostConnection, row: Row) -> None:
        here = {robot: tasks[robot] for robot in row.robots if robot in tasks}
        connection.extend(remote_vehicle)
        try:
            told = connection.ask(
                "in_place_of_bridges",
                timeout_s=WITHIN_S + MORE_S,
                fleet=fleet.fleet.name,
                robots=list(here),
                module=parameter_program.__name__,
                text=json.dumps(tasks_to_json(here)),
                within_s=WITHIN_S,
            )
        except HostError as error:
            if "No module named" in str(error):
                raise HostError(
                    f"its version of handfast cannot do that: `handfast up {file}` first"
                ) from None
            raise
        try:
            found = answers_of(json.loads(told))
            answers.update({robot: _plain(found[robot]) for robot in here})
        except (ValueError, TypeError, LookupError, AttributeError):
            raise HostError("what it says of its vehicles makes no sense") from None

    with HostJobs(fleet, [host for host in fleet.hosts if host.name in names], work) as jobs:
        while jobs.busy and not interrupt.count:
            time.sleep(LOOK_S)
    for row in jobs.rows.values():
        for robot in row.robots:
            if robot in tasks and robot not in answers:
                answers[robot] = _unknown(tasks[robot], f"{row.host}: {row.step}")
    return {robot: answers[robot] for robot in tasks}


def _plain(answer: Answer) -> Answer:
    """What a host says, fit to be printed."""
    lacking = {printable(name): printable(why) for name, why in answer.lacking.items()}
    return answer._replace(trouble=printable(answer.trouble), lacking=lacking)


def _unknown(task: Task, why: str) -> Answer:
    """Of a host that has not answered it is not known how far it came."""
    if not task.wanted:
        return Answer(why)
    return Answer("", lacking=dict.fromkeys(task.wanted, f"may be set or not: {why}"))
