"""The lines of preflight: each at each of its levels, from what a simulated rover tells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from handfast.bridges.mavlink.bridge.preflight_checks import CHECKS
from handfast.plant.backend import WAITING
from tests.rover_scene import Scene
from tests.unit.bridges.mavlink.looked import SAFE, Looked


def test_a_good_rover_has_every_line_once_and_none_is_worse_than_a_warning() -> None:
    looked = Looked(parameters=SAFE)
    assert looked.names() == [
        *("link", "type", "firmware", "mode", "arming", "EKF", "GPS", "origin", "place"),
        *("ATTITUDE", "LOCAL_POSITION_NED", "round trip", "steering", "parameters", "battery", "signing"),
    ]
    worse = {line.name: line.level for line in looked.lines() if line.level != "ok"}
    assert worse == {"signing": "warning"}
    for line in looked.lines():
        assert line.found
        assert line.level == "ok" or line.advice


@pytest.mark.parametrize("boot", ["cold", "warm"])
def test_nothing_is_well_before_it_was_looked_at(boot: str) -> None:
    """From the first heartbeat on there is a line for each check at every tick; where an answer is still to
    come it waits, and keeps the fleet from starting. Each that waited has then been answered."""
    scene = Scene(boot=boot, boot_s=8.0)
    names = [name for name, _ in CHECKS]
    waited = set()
    clear = 0.0

    def look() -> None:
        nonlocal clear
        lines = scene.bridge.plant.checks(scene.now_ns)
        if lines[0].level == "blocking":
            return
        assert [name for name in names if name not in {line.name for line in lines}] == []
        waited.update(line.name for line in lines if line.found.startswith(WAITING))
        link, reading = scene.bridge.link, scene.bridge.reading
        if not clear and all(line.level != "blocking" for line in lines):
            clear = scene.time
            assert reading.healthy
            assert link.parameters_done
            assert (link.firmware, link.status, link.clock.round_trip_ns) != ("", None, None)
            assert "m from its start" in scene.bridge.check("place").found

    scene.run(20.0, look)
    assert clear > 1.0
    assert {"place", "steering", "parameters", "round trip", "firmware", "battery"} <= waited


@pytest.mark.parametrize(
    ("forget", "name", "later"),
    [
        ({"firmware": ""}, "firmware", "does not tell its version"),
        ({"status": None}, "battery", "not measured"),
        ({"status": None, "armed": False}, "arming", "disarmed"),
    ],
)
def test_what_it_never_tells_is_waited_for_a_while(forget: dict[str, Any], name: str, later: str) -> None:
    looked = Looked()
    for what, value in forget.items():
        setattr(looked.link, what, value)
    assert looked.line(name, heard_s=9.9).found == f"waiting for its {name}"
    told = looked.line(name, heard_s=10.0)
    assert (told.level, told.found) == ("warning", later)


def test_mode_and_arming_are_the_operators_or_the_bridges() -> None:
    looked = Looked(hand_over=False)
    assert (looked.line("mode").level, looked.line("mode").found) == ("warning", "MANUAL")
    assert "operator" in looked.line("mode").advice
    assert looked.line("arming").level == "warning"
    assert looked.line("arming").advice == "its operator arms it"
    looked.section = replace(looked.section, arm=True)
    assert "the bridge will" in looked.line("mode").advice
    assert "the bridge will" in looked.line("arming").advice
    ready = Looked()
    assert (ready.line("mode").found, ready.line("arming").found) == ("GUIDED", "armed")


def test_what_keeps_it_from_arming_blocks() -> None:
    looked = Looked(boot="cold", boot_s=60.0, seconds=35.0)
    line = looked.line("arming", prearm="AHRS: not using configured AHRS type")
    assert line.level == "blocking"
    assert "AHRS: not using" in line.found
    assert looked.scene.bridge.check("arming").found.endswith("Need Position Estimate"), "by its STATUSTEXT"
    assert looked.line("EKF").level == "blocking"


@pytest.mark.parametrize(
    ("voltage", "percent", "level"),
    [
        (12.6, 90, "ok"),
        (12.6, 20, "warning"),
        (12.6, 5, "blocking"),
        (10.0, 90, "blocking"),
        (None, 90, "ok"),
        (12.0, None, "ok"),
        (None, None, "warning"),
    ],
)
def test_battery(voltage: float | None, percent: int | None, level: str) -> None:
    looked = Looked()
    assert looked.link.status is not None
    battery = looked.link.status.battery._replace(voltage=voltage, percent=percent)
    looked.link.status = looked.link.status._replace(battery=battery)
    assert looked.line("battery").level == level
