"""Laws of others in whole drives: the safety filter stands after the worst, with old messages too."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import handfast
from handfast import Law, Moment
from handfast.agent.common import plugins

SAFE_M = 0.22


class Stiff(Law):
    """A spring far too stiff for messages that are late: its robots swing at full force."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        ax, ay = now.navigation
        for other in now.neighbours:
            dx, dy = now.position[0] - other.position[0], now.position[1] - other.position[1]
            rho = max((dx * dx + dy * dy) ** 0.5, 1e-6)
            closing = (
                dx * (now.velocity[0] - other.velocity[0]) + dy * (now.velocity[1] - other.velocity[1])
            ) / rho
            push = 100.0 * (other.distance - rho) - 10.0 * closing
            ax, ay = ax + push * dx / rho, ay + push * dy / rho
        return ax, ay


class Ram(Law):
    """Everybody into everybody."""

    def acceleration(self, now: Moment) -> tuple[float, float]:
        x = sum(other.position[0] - now.position[0] for other in now.neighbours)
        y = sum(other.position[1] - now.position[1] for other in now.neighbours)
        return 1e3 * x, 1e3 * y


class Gather(Law):
    """Everybody to one point, as fast as can be: a crowd as dense as the filter lets it be."""

    pull, damping = 5.0, 0.5

    def acceleration(self, now: Moment) -> tuple[float, float]:
        (x, y), (vx, vy) = now.position, now.velocity
        return self.pull * (2.0 - x) - self.damping * vx, self.pull * (2.0 - y) - self.damping * vy


class Soft(Gather):
    """The same, gently."""

    pull, damping = 0.3, 1.0


PAUSED = """
[[faults.rule]]
robot = 2
pause = "agent"
at = 4
for = 5
"""


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    yield
    plugins._registered.clear()


@pytest.mark.parametrize("law", [Stiff, Ram])
@pytest.mark.parametrize("delay", ["0ms", "50ms", "100ms", "150ms"])
def test_no_law_brings_robots_too_near_to_each_other(law: type[Law], delay: str) -> None:
    recording = handfast.simulate("delta", {"faults.delay": delay}, law=law, duration=6, check=False)
    assert recording.metrics["min_distance_m"]["any"] > SAFE_M
    assert not [reason for reason in recording.reasons if "within" in reason]


@pytest.mark.parametrize(
    ("fleet", "law", "faults", "duration"),
    [
        ("reserve", Soft, "crash", 12),
        ("line10", Gather, PAUSED, 6),
    ],
)
def test_what_is_not_known_of_one_robot_does_not_push_others_into_each_other(
    fleet: str, law: type[Law], faults: str, duration: float
) -> None:
    recording = handfast.simulate(fleet, law=law, faults=faults, duration=duration, check=False)
    assert recording.metrics["min_distance_m"]["any"] > SAFE_M


def test_a_law_that_fails_in_all_robots_has_settled_nothing() -> None:
    class Breaks(Law):
        def acceleration(self, now: Moment) -> tuple[float, float]:
            if now.time > 2.0:
                raise RuntimeError("no idea")
            return now.navigation

    recording = handfast.simulate("delta", law=Breaks, duration=4, check=False)
    assert recording.metrics["settling_time_s"] is None
    (reason,) = (reason for reason in recording.reasons if "no idea" in reason)
    assert reason.startswith("Robots 1, 2, 3, 4, 5 and 6 ended the drive in state fault")
