"""Why a fleet cannot start yet, in words (PURE)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from agent.messages import PlantState, Status
from agent.supervision import State
from deploy.wording import robots


def waits(
    ids: Sequence[int], statuses: Mapping[int, Status], plants: Mapping[int, PlantState]
) -> dict[int, str]:
    """What each robot that is not ready waits for.

    A robot whose own body keeps it from driving also keeps its neighbours from being ready: where there is
    one, those that only wait for others are left out.
    """
    own: dict[int, str] = {}
    others: dict[int, str] = {}
    for robot in ids:
        status, plant = statuses.get(robot), plants.get(robot)
        if status is not None and status.state == State.READY.value:
            continue
        if plant is None:
            own[robot] = "nothing heard from its plant"
        elif not plant.healthy or not plant.obeying:
            own[robot] = plant.note or "its body does not obey"
        else:
            others[robot] = "nothing heard" if status is None else status.reason or status.state
    return own or others


def in_words(waits: Mapping[int, str]) -> str:
    """All of them on one line; robots that wait for the same are named together."""
    who: dict[str, list[int]] = {}
    for robot, why in waits.items():
        who.setdefault(why, []).append(robot)
    return "; ".join(f"{robots(ids)}: {why}" for why, ids in who.items())
