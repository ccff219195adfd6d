"""A law of others in an agent: what it is given, what becomes of what it gives, and its mistakes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from handfast.agent.control.own_law import LawError
from handfast.agent.core import Agent
from handfast.agent.supervision.state_machine import State
from tests.unit.agent.agent_bench import PERIOD, Bench, brakes, fleet
from tests.unit.agent.control.laws import Good, known

HERE = "tests.unit.agent.control.laws"


@pytest.fixture(autouse=True)
def _known() -> Iterator[None]:
    with known():
        yield


def bench(law: str, *overrides: str) -> Bench:
    return Bench(f"control.law={law}", *overrides)


def test_it_is_given_the_instant_for_which_it_acts():
    driven = bench("Good")
    hand = driven.drive().hand
    assert hand is not None
    now = Good.last
    (other,) = now.neighbours
    assert (now.period, other.robot, other.distance, other.rate) == (0.02, 2, 1.0, 0.0)
    assert 0.0 < other.weight <= 1.0
    assert other.age == pytest.approx(PERIOD / 1e9)
    assert now.time == pytest.approx(0.01, abs=0.011)
    assert now.position == pytest.approx((hand.x, hand.y), abs=0.05)
    assert now.reference.velocity == pytest.approx((0.1, 0.0))
    assert now.navigation == pytest.approx((hand.navigation_x, hand.navigation_y))
    assert other.position == pytest.approx((1.5, 0.2), abs=0.02)
    driven.run(10)
    assert Good.last.time == pytest.approx(now.time + 0.2)


def test_its_acceleration_stands_in_the_place_of_the_constraint_force():
    out = bench("Good", "control.good.push=0.5").drive().hand
    assert out is not None
    assert (out.constraint_x, out.constraint_y) == pytest.approx((0.5, 0.0))
    assert out.multipliers == ()
    free = bench("Good").drive().hand
    assert free is not None
    assert (free.constraint_x, free.constraint_y) == pytest.approx((0.0, 0.0))
    assert (free.navigation_x, free.navigation_y) == (out.navigation_x, out.navigation_y)


def test_the_safety_filter_stands_after_it():
    driven = bench("Good", "control.good.push=10.0")
    driven.other = (0.6, 0.0, 0.0, 0.0)
    out = driven.drive().hand
    assert out is not None
    assert out.constraint_x == pytest.approx(10.0)
    assert out.correction_x < -5.0


def test_it_is_restarted_whenever_the_robot_begins_to_drive():
    driven = bench("Good")
    driven.drive()
    assert Good.restarts == 1
    driven.run(5)
    assert Good.restarts == 1
    driven.stop(1)
    driven.run(100)
    driven.resume(2)
    driven.run(60)
    assert driven.state is State.RUNNING
    assert Good.restarts == 2


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ("Raises", "ZeroDivisionError: float division by zero (laws.py:"),
        ("Scalar", "acceleration() must return two numbers (x, y) in m/s2, got 3.0"),
        ("Text", "acceleration() must return two numbers (x, y) in m/s2, got '12'"),
        ("Late", "acceleration() must return two numbers (x, y) in m/s2, got (nan, 0.0)"),
        ("ManyNumbers", "numbers must be at most 16 finite numbers, got (0.0, 0.0"),
        ("WrongSignature", "TypeError: WrongSignature.acceleration() takes 1 positional argument but 2 were"),
        ("BadRestart", "RuntimeError: not now (laws.py:"),
        ("Cancelled", "CancelledError (laws.py:"),
        ("Closed", "ValueError: no restart (laws.py:"),
        (
            "RestartSignature",
            "TypeError: RestartSignature.restart() missing 1 required positional argument: 'now'; write def "
            "restart(self)",
        ),
    ],
)
def test_a_law_that_fails_is_a_fault_that_names_it_and_is_not_asked_again(law: str, says: str):
    driven = bench(law)
    driven.listen()
    driven.mission()
    states = []
    for _ in range(60):
        assert brakes(driven.tick()) or driven.state is State.RUNNING
        states.append(driven.state)
    assert driven.state is State.FAULT
    assert driven.agent.condition[1].startswith(f"law {HERE}:{law}: {says}")
    assert "\n" not in driven.agent.condition[1]
    first = states.index(State.FAULT)
    assert set(states[first:]) == {State.FAULT}
    driven.stop(1)
    driven.resume(2)
    driven.run(20)
    assert driven.state is State.FAULT  # as with numbers of our own that fail: nothing mends the program


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ("NotMade", "KeyError: 'gain' (laws.py:"),
        ("OwnSignature", "TypeError: OwnSignature.__init__() takes 1 positional argument but 4 were given"),
        ("WithoutMethod", "it has no method acceleration(self, now)"),
        ("Nothing", "its __new__ must make an instance of the class, not NoneType"),
    ],
)
def test_a_law_that_cannot_be_made_is_refused_in_one_line(law: str, says: str):
    with pytest.raises(LawError) as refused:
        Agent(fleet(f"control.law={law}"), 1)
    assert str(refused.value).startswith(f"law {HERE}:{law}: {says}")
    assert "\n" not in str(refused.value)


def test_only_a_subclass_of_law_is_one():
    with pytest.raises(ValueError, match=r"NoLaw: is no subclass of Law"):
        fleet("control.law=NoLaw")


def test_others_do_not_load_it():
    code = "import handfast.agent.core, sys; print([name for name in sys.modules if 'own_law' in name])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
