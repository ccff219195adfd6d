"""What vehicles say before a drive: when it is complete, and what it means."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import Checks, PlantState, Status
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.drive.preflight import Found, death, passed, summary, to_json
from handfast.deploy.drive.readiness import SETTLE_NS, Line, VehicleChecks, may_begin, waits

ROVERS = load_fleet(FLEETS / "rovers.toml", ["robot.6.plant=unicycle"])
T0 = 1_800_000_000 * NS_PER_S
LINK = ("link", "ok", "system 1", "")
COLD = ("EKF", "blocking", "waiting for its EKF to start", "give it open sky")
UNARMED = ("arming", "blocking", "disarmed, not ready to arm", "see its ground station")
FAR = ("origin", "blocking", "12 km from the datum", "correct [datum]")
OFF = ("FS_GCS_ENABLE", "warning", "0: off", "set 1")


class Fleet:
    """All rovers say that they are well, but for those that a test lets say something else."""

    def __init__(self) -> None:
        self.checks = VehicleChecks(ROVERS)
        self.now_ns = T0
        for robot in (1, 2, 3, 4, 5):
            self.says(robot, LINK)

    def says(self, robot: int, *lines: tuple[str, str, str, str], after_ns: int = 0) -> None:
        self.now_ns += after_ns
        message = Checks(robot, 0, self.now_ns, tuple(lines))
        self.checks.feed(self.now_ns, key_expressions.checks("rovers", robot), message)

    @property
    def complete(self) -> bool:
        return self.checks.complete(self.now_ns)

    @property
    def refusals(self) -> list[str]:
        return self.checks.refusals(self.now_ns)


def test_a_fleet_is_complete_when_all_its_vehicles_have_spoken() -> None:
    checks = VehicleChecks(ROVERS)
    assert checks.robots == (1, 2, 3, 4, 5), "a simulated unicycle has nothing to say"
    assert not checks.complete(T0)
    assert checks.waits()[3] == "its bridge has said nothing yet"
    fleet = Fleet()
    assert fleet.complete
    assert (fleet.refusals, fleet.checks.waits(), fleet.checks.warnings()) == ([], {}, [])


def test_what_waits_is_waited_for_and_no_reason_to_refuse() -> None:
    fleet = Fleet()
    for _ in range(100):
        fleet.says(3, LINK, COLD, after_ns=NS_PER_S)
    assert not fleet.complete
    assert fleet.refusals == []
    assert fleet.checks.waits() == {3: "waiting for its EKF to start"}
    fleet.says(3, LINK, after_ns=NS_PER_S)
    assert fleet.complete


def test_what_blocks_is_a_reason_once_it_has_stayed() -> None:
    fleet = Fleet()
    fleet.says(3, LINK, FAR)
    assert fleet.refusals == []
    assert not fleet.complete
    fleet.says(3, LINK, FAR, after_ns=SETTLE_NS - 1)
    assert fleet.refusals == []
    fleet.says(3, LINK, FAR, after_ns=1)
    assert fleet.refusals == ["robot 3: origin: 12 km from the datum (correct [datum])"]
    assert fleet.complete, "nothing more is to come"
    fleet.says(3, LINK, after_ns=1)
    assert fleet.refusals == []


def test_what_blocks_while_the_same_vehicle_waits_may_follow_from_it() -> None:
    fleet = Fleet()
    fleet.says(3, COLD, UNARMED)
    fleet.says(4, FAR)
    fleet.says(3, COLD, UNARMED, after_ns=SETTLE_NS)
    assert fleet.refusals == ["robot 4: origin: 12 km from the datum (correct [datum])"]
    fleet.says(3, UNARMED)
    fleet.says(3, UNARMED, after_ns=SETTLE_NS - 1)
    assert len(fleet.refusals) == 1
    fleet.says(3, UNARMED, after_ns=1)
    assert len(fleet.refusals) == 2


def test_a_line_that_goes_and_comes_has_not_stayed() -> None:
    fleet = Fleet()
    for _ in range(3):
        fleet.says(3, FAR, after_ns=SETTLE_NS - 1)
        fleet.says(3, LINK, after_ns=1)
    fleet.says(3, FAR)
    assert fleet.refusals == []


def test_a_vehicle_whose_bridge_died_is_not_waited_for() -> None:
    fleet = Fleet()
    fleet.says(3, COLD)
    fleet.says(4, FAR)
    assert not fleet.checks.complete(fleet.now_ns, without={3})
    assert fleet.checks.complete(fleet.now_ns, without={3, 4})


@pytest.mark.parametrize(
    ("key", "robot", "time_ns"),
    [
        (key_expressions.checks("rovers", 4), 3, T0 + 1),
        (key_expressions.checks("other", 3), 3, T0 + 1),
        (key_expressions.checks("rovers", 6), 6, T0 + 1),
        (key_expressions.checks("rovers", 99), 99, T0 + 1),
        (key_expressions.checks("rovers", 3), 3, T0 - 1),
    ],
)
def test_what_is_no_vehicles_or_old_changes_nothing(key: str, robot: int, time_ns: int) -> None:
    fleet = Fleet()
    fleet.checks.feed(T0, key, Checks(robot, 9, time_ns, (COLD,)))
    assert fleet.complete
    assert fleet.checks.lines(3) == (Line(*LINK),)


# --- why a fleet does not start ------------------------------------------------------------------


def status(robot: int, state: str, reason: str) -> Status:
    return Status(robot, 1, T0, state, "", reason, 0, 0, (), (), (), ())


def plant(robot: int, *, healthy: bool = True, obeying: bool = True, note: str = "") -> PlantState:
    return PlantState(robot, 1, T0, *[0.0] * 7, False, healthy, obeying, note)


def test_those_that_only_wait_for_others_are_not_named() -> None:
    silent = status(1, "waiting", "silent neighbours: 2, 3")
    statuses = {1: silent, 2: status(2, "waiting", "mode MANUAL, not GUIDED"), 4: status(4, "ready", "")}
    plants = {
        1: plant(1),
        2: plant(2, obeying=False, note="mode MANUAL, not GUIDED"),
        3: plant(3, healthy=False, note="waiting for its GPS"),
        4: plant(4, healthy=False, note="lost just now"),
    }
    found = waits((1, 2, 3, 4, 5), statuses, plants, may_begin)
    assert found == {
        2: "mode MANUAL, not GUIDED",
        3: "waiting for its GPS",
        5: "nothing heard from its plant",
    }
    assert waits((1,), statuses, plants, may_begin) == {1: "silent neighbours: 2, 3"}
    assert waits((4,), statuses, plants, may_begin) == {}


# --- the table -----------------------------------------------------------------------------------

FOUND: Found = {1: [Line(*LINK), Line(*OFF)], 2: [Line(*LINK), Line(*FAR)], 6: []}


def test_a_blocking_line_is_what_fails() -> None:
    assert not passed(FOUND)
    assert passed({1: FOUND[1], 6: []})
    assert summary(FOUND) == "BLOCKED: robot 2: origin"
    assert summary({1: FOUND[1], 6: []}) == "CLEAR, with 1 warning"
    assert summary({6: []}) == "CLEAR"


def test_other_programs_get_all_of_it() -> None:
    import json

    content = json.loads(to_json("rovers", FOUND))
    assert (content["fleet"], content["passed"]) == ("rovers", False)
    assert content["robots"][1] == {
        "robot": 2,
        "simulated": False,
        "lines": [Line(*LINK)._asdict(), Line(*FAR)._asdict()],
    }
    assert content["robots"][2] == {"robot": 6, "simulated": True, "lines": []}


def test_a_bridge_that_died_is_a_blocking_line_with_its_last_words() -> None:
    line = death("plant", "exit status 2", ["robot 3 plant: starting", "robot 3 plant: key: no such file"])
    assert line.level == "blocking"
    assert line.found == "it ended (exit status 2): robot 3 plant: key: no such file"
    assert "simulated rover" in death("vehicle", "killed by SIGKILL", []).found


def test_a_vehicle_that_boots_is_waited_for_and_one_that_is_not_there_is_not() -> None:
    fleet = Fleet()
    assert not fleet.checks.booting()
    fleet.says(2, ("link", "blocking", "waiting for it: no heartbeat of a vehicle yet", "is it on?"))
    assert not fleet.checks.booting(), "nothing but its link: it is not there"
    fleet.says(3, LINK, COLD)
    assert fleet.checks.booting()
    assert not fleet.checks.booting(without=[3])
    fleet.says(3, LINK, FAR)
    assert not fleet.checks.booting(), "that does not mend itself"
