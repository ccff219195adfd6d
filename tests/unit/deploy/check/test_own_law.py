"""What `check` says of a law of others, and what it does not say of it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat
from typing import Any

import pytest

from handfast.agent.common import plugins
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.analysis import patience
from handfast.deploy.check.check import Finding, check
from handfast.deploy.check.description import describe
from handfast.deploy.console.arguments import fleet_path
from tests.unit.agent.control.laws import Modal, known


class EndlessModes(Modal):
    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return repeat((1.0, 2.0, True))


class NumberOfModes(Modal):
    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return 3


class TextOfModes(Modal):
    @classmethod
    def modes(cls, fleet: Any, settings: Any) -> Any:
        return "abcdefghijkl"


class MethodOfModes(Modal):
    def modes(self, fleet: Any, settings: Any) -> Any:  # type: ignore[override]
        return None


OWN = (EndlessModes, NumberOfModes, TextOfModes, MethodOfModes)


@pytest.fixture(autouse=True)
def _known() -> Iterator[None]:
    with known():
        for kind in OWN:
            plugins.register(kind.__name__, kind)
        yield


def delta(law: str, *overrides: str) -> Fleet:
    return load_fleet(fleet_path("delta"), [f"control.law={law}", *overrides])


def found(law: str, *overrides: str) -> list[Finding]:
    return [each for each in check(delta(law, *overrides)) if each.place == "control.law"]


def test_what_cannot_be_predicted_is_said_once_and_nothing_of_another_law():
    law = delta("Good", "control.kp=0", "control.coupling=edge")
    findings = check(law)
    assert [(each.level, each.place) for each in findings] == [("info", "control.law")]
    assert findings[0].message == (
        "law Good cannot be predicted (whether it is stable, when it settles, where accelerations are "
        "clipped and how near edges come): simulate it"
    )
    text = describe(law)
    assert '  law: Good, a plugin; push 0.0, mistake "", c1 0.4, c2 0.6; at most 5 m/s2' in text
    assert "settling" not in text
    assert "bound" not in text


def test_a_law_that_gives_its_modes_is_judged_by_them():
    law = delta("Modal", "fleet.duration_s=3")
    assert [each.place for each in check(law)] == ["fleet.duration_s", "control.law"]
    assert "stable" not in found("Modal")[0].message
    assert "settling: edges within 5%" in describe(law)
    (stiff,) = [each for each in check(delta("Modal", "control.c2=200")) if each.place == "fleet.rate_hz"]
    assert stiff.level == "error"
    assert stiff.message.endswith("or lower its gains")


@pytest.mark.parametrize(
    ("law", "says"),
    [
        ("Raises", "ZeroDivisionError: float division by zero (laws.py:"),
        ("NotMade", "KeyError: 'gain' (laws.py:"),
        (
            "OwnSignature",
            "TypeError: OwnSignature.__init__() takes 1 positional argument but 4 were given; write def "
            "__init__(self, robot, fleet, settings)",
        ),
        (
            "WrongSignature",
            "TypeError: WrongSignature.acceleration() takes 1 positional argument but 2 were given; write "
            "def acceleration(self, now)",
        ),
        ("Scalar", "acceleration() must return two numbers (x, y) in m/s2, got 3.0"),
        ("WrongInside", "TypeError: unsupported operand type(s) for +: 'int' and 'str' (laws.py:"),
        ("WithoutMethod", "it has no method acceleration(self, now)"),
        ("Asynchronous", "acceleration() cannot be async: write def acceleration(self, now)"),
        ("BadRestart", "RuntimeError: not now (laws.py:"),
        ("ManyNumbers", "numbers must be at most 16"),
        ("BadModes", "ValueError: modes() must give finite numbers"),
    ],
)
def test_each_mistake_is_one_error(law: str, says: str):
    (finding,) = found(law)
    assert finding.level == "error"
    assert finding.message.startswith(f"law tests.unit.agent.control.laws:{law}: {says}")
    assert describe(delta(law))


def test_a_slow_law_is_a_warning_that_names_it():
    warning, _ = found("Slow")
    assert warning.level == "warning"
    assert warning.message.startswith("law Slow takes ")
    assert "of a period" in warning.message
    assert (
        len(found("Slow", "control.plant_timeout_s=1", "control.wrench_timeout_s=1", "fleet.rate_hz=5")) == 1
    )


@pytest.mark.parametrize(("law", "what"), [("HangsMade", "it"), ("HangsModes", "modes()")])
def test_a_law_that_never_returns_is_one_error(law: str, what: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(patience, "ANSWER_S", 0.5)  # a law that answers has time to, on a busy machine too
    (finding,) = found(law)
    assert finding.level == "error"
    assert f"{what} did not return within 0.5 s" in finding.message


def test_modes_are_two_for_each_robot():
    (few,) = found("FewModes")
    assert (few.level, few.message) == (
        "error",
        "law FewModes: modes() must give two modes for each robot that has a place, 12, got 1",
    )


def test_modes_that_do_not_end_are_too_many():
    (many,) = found("EndlessModes")
    assert many.message.endswith("modes() must give two modes for each robot that has a place, 12, got more")


@pytest.mark.parametrize("law", ["NumberOfModes", "TextOfModes", "MethodOfModes"])
def test_modes_that_are_none_say_what_they_would_be(law: str):
    (wrong,) = found(law)
    assert "\n" not in wrong.message
    assert "modes(cls, fleet, settings)" in wrong.message
    assert wrong.message.endswith("gives two (k1, k2, shape) for each robot, or None")
