"""Numbers with units are read exactly, refused by what is right, and written so that they are read again."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from handfast.agent.common.quantities import (
    UNITS,
    bits_per_second,
    decibels,
    metres,
    metres_per_second,
    quantity,
    ratio,
    seconds,
    text,
)


@pytest.mark.parametrize(
    ("read", "raw", "value"),
    [
        (seconds, "200ms", 0.2),
        (seconds, " 0.2 s ", 0.2),
        (seconds, "80us", 80e-6),
        (seconds, "1.5min", 90.0),
        (seconds, 0.2, 0.2),
        (seconds, "0.2", 0.2),
        (seconds, 3, 3.0),
        (seconds, "-5ms", -0.005),
        (ratio, "30%", 0.3),
        (ratio, "7%", 0.07),
        (ratio, 0.3, 0.3),
        (ratio, "0.3", 0.3),
        (ratio, 1, 1.0),
        (ratio, "1e-3%", 1e-5),
        (metres, "20cm", 0.2),
        (metres, 10, 10.0),
        (metres_per_second, "5.4km/h", 1.5),
        (decibels, "4dB", 4.0),
        (bits_per_second, "100kbit", 100e3),
        (bits_per_second, "1Mbit", 1e6),
        (bits_per_second, "10kbps", 80e3),
        (bits_per_second, "1kibit", 1024.0),
        (bits_per_second, "250 kbit/s", 250e3),
        (bits_per_second, "1.5Mbit/s", 1.5e6),
        (bits_per_second, 9600, 9600.0),
    ],
)
def test_quantities_are_read_in_si_units(read: Callable[[object], float], raw: object, value: float):
    assert read(raw) == value


@pytest.mark.parametrize(
    ("read", "raw", "said"),
    [
        (seconds, "fast", 'must be a number (s) or a text such as "200ms" (units: us, ms, s, min, h), got'),
        (seconds, "200 apples", 'got "200 apples"'),
        (seconds, "", 'got ""'),
        (seconds, True, "got True"),
        (seconds, None, "got None"),
        (seconds, [1], "got [1]"),
        (seconds, "9" * 61, "got"),
        (seconds, "1e999s", 'must be a finite number, got "1e999s"'),
        (seconds, float("nan"), "must be a finite number"),
        (seconds, 10**400, "must be a finite number, got an integer of 1329 bits"),
        (ratio, "120%", 'must be between 0% and 100%, got "120%"'),
        (ratio, "30", 'must be between 0% and 100%, got "30"; a percentage is written "30%"'),
        (ratio, 30, 'must be between 0% and 100%, got 30; a percentage is written "30%"'),
        (ratio, "-1%", "must be between 0% and 100%"),
        (metres, "3s", "units: mm, cm, m, km"),
        (bits_per_second, "100kbaud", "kbit"),
    ],
)  # fmt: skip
def test_what_is_no_quantity_is_refused_by_what_is_right(
    read: Callable[[object], float], raw: object, said: str
):
    with pytest.raises(ValueError) as caught:
        read(raw)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_percent_over_a_hundred_has_no_hint_about_percent():
    with pytest.raises(ValueError) as caught:
        ratio("120%")
    assert "written" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "unit", "written"),
    [
        (0.2, "s", "200ms"),
        (80e-6, "s", "80us"),
        (2.5, "s", "2.5s"),
        (3600.0, "s", "3600s"),
        (0.0, "s", "0s"),
        (0.3, "ratio", "30%"),
        (0.0, "ratio", "0%"),
        (1.0, "ratio", "100%"),
        (0.001, "ratio", "0.1%"),
        (100e3, "bit/s", "100kbit"),
        (104e3, "bit/s", "104kbit"),
        (0.5, "m", "0.5m"),
        (1500.0, "m/s", "1500m/s"),
        (4.0, "dB", "4dB"),
        (0.1 + 0.2, "ratio", "0.30000000000000004"),  # no percentage reads exactly so
    ],
)
def test_quantities_are_written_handily(value: float, unit: str, written: str):
    assert text(value, unit) == written
    assert quantity(written, unit) == value


def test_every_unit_reads_its_example_and_all_its_suffixes():
    for name, unit in UNITS.items():
        assert quantity(unit.example, name) > 0
        for suffix in unit.suffixes:
            assert quantity(f"2{suffix}", name) > 0
