"""Why a fleet cannot start yet, in words, and whether it has come to rest (PURE)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from handfast.agent.messages.types import PlantState, Status
from handfast.agent.supervision.state_machine import State, at_rest
from handfast.deploy.console.wording import NAMES_SHOWN, grouped, robots


def is_ready(state: str) -> bool:
    """Whether a robot in this state keeps no fleet from starting: one in reserve just stays where it is."""
    return state in (State.READY.value, State.STANDBY.value)


def may_begin(status: Status | None, plant: PlantState | None, *, stands_by: bool = False) -> bool:
    """Whether a robot keeps no fleet from a new drive, where a resume goes with the mission: it is ready, or
    stands after a stop and could drive, or need not, as it `stands_by`."""
    if status is None:
        return False
    if status.state != State.STOPPED.value:
        return is_ready(status.state)
    return stands_by or (plant is not None and plant.healthy and plant.obeying)


def stands(status: Status | None, plant: PlantState | None) -> bool:
    """Whether a robot that was ordered to stop has come to rest, or its agent can do no more about it."""
    if status is None or status.state == State.STOPPED.value:
        return status is not None
    # These brake, whatever was said.
    brakes = status.state in (State.FAULT.value, State.STANDBY.value)
    return brakes and (plant is None or not plant.healthy or at_rest(plant.speed, plant.yaw_rate))


def waits(
    ids: Sequence[int],
    statuses: Mapping[int, Status],
    plants: Mapping[int, PlantState],
    begins: Callable[[Status | None, PlantState | None], bool],
) -> dict[int, str]:
    """What each robot waits for that does not begin, by `may_begin` or what else is asked of it.

    A robot whose own body keeps it from driving also keeps its neighbours from being ready: where there is
    one, those that only wait for others are left out.
    """
    own: dict[int, str] = {}
    others: dict[int, str] = {}
    for robot in ids:
        status, plant = statuses.get(robot), plants.get(robot)
        if begins(status, plant):
            continue
        if plant is None:
            own[robot] = "nothing heard from its plant"
        elif not plant.healthy or not plant.obeying:
            own[robot] = plant.note or "its body does not obey"
        else:
            others[robot] = "nothing heard" if status is None else status.reason or status.state
    return own or others


def in_words(waits: Mapping[int, str]) -> str:
    """On one line; robots that wait for the same are named together, and of many reasons the first few."""
    who = grouped((why, robot) for robot, why in waits.items())
    shown = [f"{robots(ids)}: {why}" for why, ids in who[:NAMES_SHOWN]]
    left = sum(len(ids) for _, ids in who[NAMES_SHOWN:])
    if left:
        shown.append(f"and {left} more robot{'s' * (left != 1)}")
    return "; ".join(shown)
