"""When a fleet can start, and when it stands."""

from __future__ import annotations

import pytest

from handfast.agent.messages.types import PlantState, Status
from handfast.deploy.drive.readiness import is_ready, may_begin, stands, waits


def status(state: str, reason: str = "") -> Status:
    return Status(1, 1, 1, state, "", reason, 1, 0, (), (), (), ())


def plant(speed: float, *, healthy: bool = True) -> PlantState:
    return PlantState(1, 1, 1, 0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0, False, healthy, True, "")


def test_a_robot_in_reserve_keeps_no_fleet_from_starting() -> None:
    assert [is_ready(state) for state in ("ready", "standby", "waiting", "fault", "")] == [
        True, True, False, False, False,
    ]  # fmt: skip
    statuses = {1: status("ready"), 2: status("standby", "in reserve"), 3: status("waiting", "for robot 9")}
    plants = {robot: plant(0.0) for robot in (1, 2, 3)}
    assert waits((1, 2, 3), statuses, plants, may_begin) == {3: "for robot 9"}


@pytest.mark.parametrize(
    ("state", "body", "does"),
    [
        ("stopped", plant(0.0), True),
        ("stopping", plant(0.0), False),  # it may have not been braked yet
        ("running", plant(0.0), False),
        ("standby", plant(0.0), True),
        ("standby", plant(0.5), False),  # it has just left, and rolls still
        ("fault", plant(0.5), False),
        ("fault", plant(0.0), True),
        ("fault", plant(0.5, healthy=False), True),  # nothing is known of it
        ("fault", None, True),
    ],
)
def test_who_stands(state: str, body: PlantState | None, does: bool) -> None:
    assert stands(status(state), body) is does


def test_a_robot_that_says_nothing_does_not_stand() -> None:
    assert not stands(None, plant(0.0))


def test_who_stands_after_a_stop_may_begin_if_its_body_could_drive():
    status = Status(3, 1, 1, "stopped", "", "stop: the fleet came up", 1, 1, (), (), (), ())
    plant = PlantState(3, 1, 1, *[0.0] * 7, False, True, True, "")
    taken = plant._replace(obeying=False, note="its operator has it: MANUAL")
    assert may_begin(status, plant)
    assert not may_begin(status, taken)
    assert not may_begin(status, plant._replace(healthy=False))
    assert not may_begin(status, None)
    assert not may_begin(None, plant)
    assert may_begin(status, taken, stands_by=True)
    assert waits((3,), {3: status}, {3: taken}, may_begin) == {3: "its operator has it: MANUAL"}
