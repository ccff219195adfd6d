"""Reports: units, what is unknown, places that are none, texts in chunks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session import reports
from handfast.bridges.mavlink.session.reports import Text, Texts


def text(content: str, number: int = 0, chunk: int = 0, severity: int = 6) -> Any:
    return SimpleNamespace(text=content, id=number, chunk_seq=chunk, severity=severity)


def origin(latitude: int, longitude: int, altitude: int = 0) -> Any:
    return SimpleNamespace(latitude=latitude, longitude=longitude, altitude=altitude)


FULL = "x" * 50


def test_what_is_unknown_is_none() -> None:
    gps = SimpleNamespace(satellites_visible=255, eph=65535, fix_type=3)
    assert reports.gps(gps, 7) == (7, 3, 0, None)
    for voltage, percent in ((0, -1), (65535, 101)):
        status = SimpleNamespace(
            voltage_battery=voltage,
            battery_remaining=percent,
            onboard_control_sensors_present=0,
            onboard_control_sensors_enabled=0,
            onboard_control_sensors_health=0,
        )
        assert reports.status(status, 7).battery == (None, None)
        assert reports.status(status, 7).prearm_ok is None


@pytest.mark.parametrize(("latitude", "longitude"), [(0, 0), (900_000_001, 5), (5, -1_800_000_001)])
def test_an_origin_that_is_no_place_is_none(latitude: int, longitude: int) -> None:
    assert reports.origin(origin(latitude, longitude)) is None


def test_an_origin_is_in_degrees_and_metres_and_goes_back() -> None:
    place = reports.origin(origin(473_977_000, -85_456_000, 488_500))
    assert place == pytest.approx((47.3977, -8.5456, 488.5))
    assert place is not None
    assert reports.scaled(place) == (473_977_000, -85_456_000, 488_500)


def test_two_origins_are_one_but_for_rounding_also_across_the_date_line() -> None:
    here = Geodetic(47.0, 180.0, 400.0)
    assert reports.same_place(here, Geodetic(47.0000002, -179.9999998, 0.0))
    assert not reports.same_place(here, Geodetic(47.0000003, 180.0, 400.0))
    assert not reports.same_place(here, Geodetic(47.0, -179.9999997, 400.0))


@pytest.mark.parametrize(
    ("kind", "name"),
    [(255, "4.5.7"), (193, "4.5.7-rc"), (130, "4.5.7-beta"), (64, "4.5.7-alpha"), (0, "4.5.7-dev")],
)
def test_a_version_is_written_as_its_makers_do(kind: int, name: str) -> None:
    message = SimpleNamespace(flight_sw_version=0x04050700 | kind, flight_custom_version=bytes(8))
    assert reports.firmware(message) == name
    message.flight_custom_version = b"1a2b\xff\x00\n-"
    assert reports.firmware(message) == f"{name} (1a2b)"


def test_a_short_text_is_whole_at_once() -> None:
    assert Texts().take(text("PreArm: no\x07 GPS", severity=2), 5) == [Text(5, 2, "PreArm: no GPS")]


def test_chunks_are_joined_in_their_order() -> None:
    texts = Texts()
    assert texts.take(text(FULL, 3, 0), 5) == []
    assert texts.take(text("end", 3, 1), 9) == [Text(5, 6, FULL + "end")]


def test_a_lost_chunk_ends_a_text_and_a_lost_beginning_shows() -> None:
    texts = Texts()
    texts.take(text(FULL, 3, 0), 5)
    assert texts.take(text("end", 3, 2), 9) == [Text(5, 6, FULL), Text(9, 6, "...end")]


def test_a_text_whose_end_does_not_come_is_told_after_a_second() -> None:
    texts = Texts()
    texts.take(text(FULL, 3, 0), 5)
    assert texts.overdue(5 + NS_PER_S) == []
    assert texts.overdue(6 + NS_PER_S) == [Text(5, 6, FULL)]
    assert texts.overdue(9 * NS_PER_S) == []


def test_texts_without_end_are_cut_and_too_many_at_once_too() -> None:
    texts = Texts()
    ended = [done for chunk in range(20) for done in texts.take(text(FULL, 3, chunk), 5)]
    assert ended == [Text(5, 6, FULL * 20)]
    for number in range(1, 9):
        assert texts.take(text(FULL, number, 0), number) == []
    assert texts.take(text(FULL, 9, 0), 9) == [Text(1, 6, FULL)]
