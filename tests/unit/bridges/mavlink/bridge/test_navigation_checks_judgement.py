"""What a bridge found of its vehicle's reports ages, though nothing new is said."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.bridge.backend import JUDGED_NS
from handfast.bridges.mavlink.bridge.driving_checks import REPORTED_NS
from tests.rover_scene import Scene


@pytest.mark.parametrize(
    ("report", "found", "name"),
    [(constants.MESSAGE_EKF_STATUS_REPORT, "ekf", "EKF"), (constants.MESSAGE_GPS_RAW_INT, "gps", "GPS")],
)
def test_a_report_that_comes_no_more_stops_it(report: int, found: str, name: str) -> None:
    scene = Scene()
    scene.drive(0.3)
    scene.run(2.0)
    link = scene.bridge.link
    link._handlers[report] = lambda _arrival_ns, _message: None
    silent_ns = getattr(link, found).arrival_ns
    scene.run((silent_ns + REPORTED_NS - scene.now_ns) / NS_PER_S - 0.1)
    assert scene.bridge.reading.healthy
    scene.run(0.1 + JUDGED_NS / NS_PER_S + 0.1)
    assert not scene.bridge.reading.healthy
    assert scene.bridge.reading.note == f"waiting for its {name}: silent for 5 s"
    scene.run(3.0)
    assert scene.bridge.setpoints()[-1][1] == 0.0
    assert abs(scene.rover.speed) < 0.05


def test_a_report_that_is_bad_counts_at_once() -> None:
    scene = Scene()
    scene.drive(0.3)
    link = scene.bridge.link
    assert link.ekf is not None
    link.ekf = link.ekf._replace(flags=constants.EKF_UNINITIALIZED)
    scene.tick()
    assert scene.bridge.reading.note == "waiting for its EKF to start"
