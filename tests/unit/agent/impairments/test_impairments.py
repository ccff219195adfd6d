"""Impairments are read as netem writes them, and as people do; what cannot be is refused by what is right."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import pytest

from handfast.agent.common import random_streams
from handfast.agent.impairments import loss_models
from handfast.agent.impairments.impairments import (
    Corrupt,
    Delay,
    Duplicate,
    Loss,
    Range,
    Rate,
    Reorder,
    interpolate,
    parse_ramp,
)

STREAM = random_streams.stream(7, "link", 1, 2, "hand", "something")
FIRST = 2**20
KNOWN_S = {  # the first three delays of STREAM
    "80ms 20ms": [0.08808196026379346, 0.06818349216757362, 0.08014888782278838],
    "normal 80ms 20ms 25%": [0.09060605654400457, 0.06736495983863322, 0.08159369711957458],
    "pareto 80ms 20ms 90%": [0.07992581465631027, 0.07791686453503657, 0.082818232789476],
}


# --- reading and writing ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("raw", "value", "written"),
    [
        (0.2, Delay("constant", 0.2), "200ms"),
        (0, Delay("constant", 0.0), "0s"),
        ("0.2", Delay("constant", 0.2), "200ms"),
        ("constant 80ms", Delay("constant", 0.08), "80ms"),
        ("80ms 20ms", Delay("uniform", 0.08, 0.02), "80ms 20ms"),
        ("80ms 20ms 25%", Delay("uniform", 0.08, 0.02, 0.25), "80ms 20ms 25%"),
        ("uniform 80ms 20ms", Delay("uniform", 0.08, 0.02), "80ms 20ms"),
        ("normal 80ms 20ms 0%", Delay("normal", 0.08, 0.02), "normal 80ms 20ms"),
        ("80ms 20ms 25% distribution pareto", Delay("pareto", 0.08, 0.02, 0.25), "pareto 80ms 20ms 25%"),
        ("paretonormal 1s 1ms 5%", Delay("paretonormal", 1.0, 0.001, 0.05), "paretonormal 1s 1ms 5%"),
        (0.3, Loss("random", (0.3, 0.0)), "30%"),
        ("30% 25%", Loss("random", (0.3, 0.25)), "30% 25%"),
        ("random 30%", Loss("random", (0.3, 0.0)), "30%"),
        ("gemodel 1%", Loss("gemodel", (0.01, 0.99, 1.0, 0.0)), "gemodel 1%"),
        ("gemodel 1% 10%", Loss("gemodel", (0.01, 0.1, 1.0, 0.0)), "gemodel 1% 10%"),
        ("gemodel 1% 10% 70% 0.1%", Loss("gemodel", (0.01, 0.1, 0.7, 0.001)), "gemodel 1% 10% 70% 0.1%"),
        ("state 1%", Loss("state", (0.01, 0.99, 0.0, 1.0, 0.0)), "state 1%"),
        ("state 1% 10% 20% 30% 2%", Loss("state", (0.01, 0.1, 0.2, 0.3, 0.02)), "state 1% 10% 20% 30% 2%"),
        ("every 3", Loss("every", every=3), "every 3"),
        ("1%", Duplicate(0.01), "1%"),
        ("1% 25%", Duplicate(0.01, 0.25), "1% 25%"),
        (0.001, Corrupt(0.001), "0.1%"),
        ("25% 50%", Reorder(0.25, 0.5), "25% 50%"),
        ("25% 50% gap 5", Reorder(0.25, 0.5, 5), "25% 50% gap 5"),
        ("gap 5", Reorder(1.0, 0.0, 5), "100% gap 5"),
        ("100kbit", Rate(100e3), "100kbit"),
        (9600, Rate(9600.0), "9.6kbit"),
        ("disc 10m", Range("disc", 10.0), "disc 10m"),
        ("disc 10 speed 1500", Range("disc", 10.0, speed_mps=1500.0), "disc 10m speed 1500m/s"),
        ("logdistance 10m", Range("logdistance", 10.0), "logdistance 10m exponent 2.7 shadowing 4dB"),
        (
            "logdistance 10m speed 1500m/s retries 3 5ms exponent 3",
            Range("logdistance", 10.0, 3.0, 4.0, 3, 0.005, 1500.0),
            "logdistance 10m exponent 3.0 shadowing 4dB retries 3 5ms speed 1500m/s",
        ),
    ],
)
def test_impairments_are_read_and_written(raw: object, value: Any, written: str):
    read = type(value).parse(raw)
    assert read == value
    assert str(read) == written
    assert type(value).parse(written) == value


DELAY_WANTED = 'must be a number or a text such as "200ms", "80ms 20ms" or "normal 80ms 20ms 25%", got '


@pytest.mark.parametrize(
    ("kind", "raw", "said"),
    [
        (Delay, "-5ms", 'must not be negative, got "-5ms"'),
        (Delay, "2h", 'must be at most 3600s, got "2h"'),
        (Delay, "", f'{DELAY_WANTED}""'),
        (Delay, None, f"{DELAY_WANTED}None"),
        (Delay, True, f"{DELAY_WANTED}True"),
        (Delay, ["80ms"], f"{DELAY_WANTED}['80ms']"),
        (Delay, "9 " * 101, DELAY_WANTED),
        (Delay, math.inf, DELAY_WANTED),
        (Delay, "late", 'one of constant, uniform, normal, pareto, paretonormal, got "late"'),
        (Delay, "80 ms", "units: us, ms, s, min, h"),
        (Delay, "80ms -1ms", 'jitter must not be negative, got "-1ms"'),
        (Delay, "80ms 20ms 100%", 'correlation must be less than 100%, got "100%"'),
        (Delay, "80ms 20ms 25", 'correlation must be between 0% and 100%, got "25"; a percentage is'),
        (Delay, "normal 80ms", 'must be written "normal 80ms 20ms" (mean, jitter)'),
        (Delay, "normal", 'must be written "normal 80ms 20ms" (mean, jitter)'),
        (Delay, "80ms 20ms 1% 1%", 'must be written "uniform 80ms 20ms"'),
        (Delay, "80ms 20ms distribution cauchy", "must name one distribution, of uniform, normal, pareto"),
        (Delay, "normal 80ms 20ms distribution normal", "must name one distribution"),
        (Delay, "80ms distribution normal", 'must be written "normal 80ms 20ms"'),
        (Delay, "constant 80ms 20ms", 'must be written "constant 80ms"'),
        (Loss, "120%", 'must be between 0% and 100%, got "120%"'),
        (Loss, "30", 'got "30"; a percentage is written "30%"'),
        (Loss, 30, 'a percentage is written "30%"'),
        (Loss, "-1%", "must be between 0% and 100%"),
        (Loss, "30% 25% 1%", 'must be written "30%" or with a correlation "30% 25%"'),
        (Loss, "bursts", "begin with one of random, gemodel, state, every"),
        (Loss, "gemodel", 'must be written "gemodel P [R [1-H [1-K]]]"'),
        (Loss, "gemodel 1% 200%", 'r must be between 0% and 100%, got "200%"'),
        (Loss, "state 60% 10% 0% 100% 50%", "p13 + p14 must be at most 100%"),
        (Loss, "state 1% 60% 50%", "p31 + p32 must be at most 100%"),
        (Loss, "state 1% 1% 1% 1% 1% 1%", 'must be written "state P13'),
        (Loss, "every 0", 'every must be a whole number between 1 and 1000000, got "0"'),
        (Loss, "every 2.5", "every must be a whole number"),
        (Loss, "every", 'must be written "every 3"'),
        (Duplicate, "1% 2% 3%", 'must be written "1%" or with a correlation "1% 25%"'),
        (Corrupt, "2", 'a percentage is written "30%"'),
        (Reorder, "25% gap", 'correlation must be a number or a text such as "30%"'),
        (Reorder, "25% gap 0", "gap must be a whole number"),
        (Reorder, "25% 50% 50% gap 5", 'must be written "25%", "25% 50%" (correlation)'),
        (Rate, "0", 'must be at least 1bit, got "0"'),
        (Rate, "100kbit 5", 'must be written "100kbit"'),
        (Range, 10, 'must be written "disc 10m"'),
        (Range, "disc", 'must be written "disc 10m"'),
        (Range, "disc 10m retries 3 5ms", 'must be written "disc 10m"'),
        (Range, "disc 0m", 'distance must be at least 0.001m, got "0m"'),
        (Range, "logdistance 10m exponent 27", 'exponent must be a number between 1 and 10, got "27"'),
        (Range, "logdistance 10m exponent x", "exponent must be a number between 1 and 10"),
        (Range, "logdistance 10m shadowing 0dB", 'shadowing must be at least 0.1dB, got "0dB"'),
        (Range, "logdistance 10m retries 3", 'must be written "disc 10m"'),
        (Range, "logdistance 10m retries 16 5ms", "retries must be a whole number between 0 and 15"),
        (Range, "logdistance 10m retries 3 -5ms", "time of a retry must not be negative"),
        (Range, "logdistance 10m speed 1500m/s speed 1500m/s", 'must be written "disc 10m"'),
        (Range, "ball 10m", "begin with one of disc, logdistance"),
    ],
)  # fmt: skip
def test_bad_settings_are_refused_by_what_is_right(kind: Any, raw: object, said: str):
    with pytest.raises(ValueError) as caught:
        kind.parse(raw)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


# --- draws ------------------------------------------------------------------------------------


def test_delays_are_the_same_on_every_machine_and_in_every_process():
    """So that a run and its simulation agree."""
    for text, numbers in KNOWN_S.items():
        delay = Delay.parse(text)
        assert [delay.sample(STREAM, FIRST + n) for n in range(3)] == pytest.approx(numbers, rel=1e-12), text
    code = (
        "from handfast.agent.impairments.impairments import *\n"
        "from handfast.agent.common import random_streams\n"
        "s = random_streams.stream(7, 'link', 1, 2, 'hand', 'something')\n"
        "print([Delay.parse('normal 80ms 20ms 25%').sample(s, 2**20 + 999), "
        "[n for n in range(2**20, 2**20 + 99) if Loss.parse('gemodel 10% 30%').lost(s, n)]])"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = [
        Delay.parse("normal 80ms 20ms 25%").sample(STREAM, FIRST + 999),
        [n for n in range(FIRST, FIRST + 99) if Loss.parse("gemodel 10% 30%").lost(STREAM, n)],
    ]
    assert other.stdout.strip() == str(here)


@pytest.mark.parametrize(
    ("text", "lost"),
    [
        ("0%", False), ("100%", True), ("0% 50%", False), ("100% 50%", True), ("gemodel 0%", False),
        ("gemodel 0% 0%", False), ("gemodel 100% 0%", True), ("gemodel 1% 1% 0% 0%", False),
        ("gemodel 1% 1% 100% 100%", True), ("state 0%", False), ("state 1% 0%", True),
        ("state 1% 1% 1% 0%", False), ("every 1", True),
    ],
)  # fmt: skip
def test_losses_at_the_ends_are_certain(text: str, lost: bool):
    """Also where a chain never leaves a state: the one that it ends up in."""
    loss = Loss.parse(text)
    assert {loss.lost(STREAM, n) for n in range(FIRST, FIRST + 300)} == {lost}
    assert {loss.lost(stream, n) for stream in range(20) for n in range(3)} == {lost}
    assert loss.rate == float(lost)


def test_bits_to_flip_lie_in_the_message():
    corrupt = Corrupt.parse("100%")
    assert {corrupt.bit(STREAM, n, 1) for n in range(200)} == set(range(8))
    assert corrupt.bit(STREAM, 0, 0) == -1
    assert Corrupt.parse("0%").bit(STREAM, 0, 100) == -1


def test_path_loss_grows_with_distance_and_each_message_keeps_its_luck():
    channel = Range.parse("logdistance 10m")
    assert channel.failure(0.0) == 0.0
    assert channel.failure(10.0) == 0.5
    failures = [channel.failure(d) for d in (1.0, 5.0, 10.0, 20.0, 100.0)]
    assert failures == sorted(failures)
    assert failures[0] < 1e-9
    assert failures[-1] > 1 - 1e-9
    for n in range(200):  # nearer is never worse, for any one message
        heard = [channel.attempt(STREAM, n, d) is not None for d in (5.0, 8.0, 10.0, 12.0, 20.0)]
        assert heard == sorted(heard, reverse=True)


def test_chains_read_their_rows_in_order():
    three = loss_models.chain(
        (((1, 0.2), (2, 0.3), (0, 1.0)), ((0, 1.0),), ((2, 0.5), (1, 1.0))), (0.5, 0.25, 0.25)
    )
    assert three.edges == (0.2, 0.5)
    assert three.maps == ((1, 0, 2), (2, 0, 2), (0, 0, 1))


# --- ramps ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "raw", "half"),
    [
        (Loss, "0%..50%", "25%"),
        (Loss, "0% .. 50% 20%", "25% 10%"),
        (Loss, "gemodel 0% 10% .. gemodel 10% 30%", "gemodel 5% 20%"),
        (Delay, "0ms..500ms", "250ms"),
        (Delay, "normal 0ms 0ms .. normal 80ms 20ms", "normal 40ms 10ms"),
        (Delay, "0..1", "500ms"),
        (Rate, "1mbit .. 100kbit", "550kbit"),
        (Reorder, "0% gap 5 .. 50% gap 5", "25% gap 5"),
        (Range, "disc 20m .. disc 10m", "disc 15m"),
    ],
)
def test_ramps_are_linear_in_every_number(kind: Any, raw: str, half: str):
    ramp = parse_ramp(kind, raw)
    assert isinstance(ramp, tuple)
    start, end = ramp
    assert interpolate(start, end, 0.0) == start
    assert interpolate(start, end, 1.0) == end
    assert interpolate(start, end, 0.5) == kind.parse(half)


def test_ramp_moves_what_is_drawn():
    start, end = Loss.parse("0% 50%"), Loss.parse("100% 50%")
    counts = [
        sum(interpolate(start, end, f).lost(STREAM, n) for n in range(500)) for f in (0.0, 0.25, 0.75, 1.0)
    ]
    assert counts[0] == 0
    assert counts[-1] == 500
    assert counts == sorted(counts)
    assert 80 < counts[1] < 170


@pytest.mark.parametrize(
    ("kind", "raw"),
    [
        (Delay, "0ms .. 80ms 20ms"),
        (Delay, "normal 0ms 0ms .. 80ms 20ms"),
        (Loss, "every 3 .. every 9"),
        (Loss, "gemodel 1% .. state 1%"),
        (Reorder, "0% .. 50% gap 5"),
        (Range, "disc 10m .. disc 20m speed 1500m/s"),
    ],
)
def test_ramps_between_kinds_are_refused(kind: Any, raw: str):
    with pytest.raises(ValueError) as caught:
        parse_ramp(kind, raw)
    assert 'ends of one kind that differ in numbers alone, such as "normal 0ms 0ms .. normal' in str(
        caught.value
    )
