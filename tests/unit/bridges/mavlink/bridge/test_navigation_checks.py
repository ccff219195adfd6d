"""The lines of EKF, GPS, origin and place, each at each of its levels."""

from __future__ import annotations

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot import constants, frames
from tests.unit.bridges.mavlink.looked import Looked


def test_ekf_and_gps() -> None:
    looked = Looked()
    link, now_ns = looked.link, looked.found.now_ns
    assert link.ekf is not None
    assert link.gps is not None
    good_ekf, good_gps = link.ekf, link.gps
    for flags, text in (
        (good_ekf.flags | constants.EKF_GPS_GLITCHING, "glitching"),
        (good_ekf.flags | constants.EKF_CONST_POS_MODE, "to have a position"),
        (good_ekf.flags & ~constants.EKF_POS_HORIZ_ABS, "position on the earth"),
        (good_ekf.flags & ~constants.EKF_VELOCITY_HORIZ, "velocity"),
        (constants.EKF_UNINITIALIZED, "to start"),
    ):
        link.ekf = good_ekf._replace(flags=flags)
        assert looked.line("EKF").level == "blocking"
        assert text in looked.line("EKF").found
    inf = float("inf")
    for velocity, position, compass, level in (
        (0.1, 0.1, 0.4, "ok"),
        (0.1, 0.1, 0.6, "warning"),
        (0.1, 0.1, inf, "warning"),  # the current of its motors: no reason to stop
        (0.1, 0.81, 0.1, "warning"),
        (0.79, 0.79, 0.1, "warning"),
        (0.81, 0.1, 0.1, "blocking"),  # that of the velocity counts twice in Rover's own check
        (0.1, 0.81, 0.81, "blocking"),
        (0.81, 0.1, 0.81, "blocking"),
        (float("nan"), 0.1, 0.1, "blocking"),
    ):
        link.ekf = good_ekf._replace(
            velocity_variance=velocity, position_variance=position, compass_variance=compass
        )
        assert looked.line("EKF").level == level, (velocity, position, compass)
    link.ekf = good_ekf._replace(arrival_ns=now_ns - 6 * NS_PER_S)
    assert (looked.line("EKF").level, looked.line("EKF").found) == (
        "blocking",
        "waiting for its EKF: silent for 6 s",
    )
    link.ekf = good_ekf
    for changed, level in (
        ({"fix": constants.GPS_3D_FIX - 1}, "blocking"),
        ({"satellites": 5}, "warning"),
        ({"hdop": 2.5}, "warning"),
        ({"hdop": None}, "ok"),
        ({"arrival_ns": now_ns - 6 * NS_PER_S}, "blocking"),
    ):
        link.gps = good_gps._replace(**changed)
        assert looked.line("GPS").level == level, changed
    link.gps = None
    assert looked.line("GPS").found == "waiting for its GPS"


@pytest.mark.parametrize(("metres", "level"), [(40.0, "ok"), (1_500.0, "warning"), (15_000.0, "blocking")])
def test_how_far_its_origin_may_be_from_the_datum(metres: float, level: str) -> None:
    looked = Looked()
    looked.link.origin = frames.world_to_geodetic(frames.datum_of(looked.scene.fleet), metres, 0.0)
    line = looked.line("origin")
    assert line.level == level
    assert line.found.startswith(
        f"{metres:.2f} m" if level != "blocking" else "the origin of its EKF is 15 km"
    )
    assert bool(line.advice) is (level != "ok")
    looked.link.origin = None
    assert looked.line("origin").found == "waiting for the origin of its EKF"


def test_a_rover_elsewhere_than_its_start_is_warned_of() -> None:
    looked = Looked()
    assert looked.line("place").level == "ok"
    assert looked.line("place", start=(3.0, 4.2)).level == "warning"
    assert "6.0 m from its start" in looked.line("place", start=(3.0, 4.2)).found
    line = looked.line("place", place=None)
    assert (line.level, line.found) == ("blocking", "waiting for its position")
