"""Fates of a run as text, and a run from such a text."""

from __future__ import annotations

import base64
import tomllib
import zlib
from pathlib import Path
from random import Random

import numpy as np
import pytest

from agent.impairments import recorded_fates
from agent.impairments.recorded_fates import DELAY_US_MAX, UNTOUCHED, decode_fates, encode_fates
from agent.messages.sequence_numbers import FIRST_ROUND
from agent.messages.types import CORRUPTED, LOST
from deploy.faults.replay_scenario import write_scenario
from deploy.recording.links import Link
from deploy.recording.recorder import RecordingError
from deploy.recording.recording import Recording
from tests.unit.deploy.simulated_run import driven, leave_run, recorded, trio


def test_fates_come_back_as_they_were() -> None:
    random = Random(5)
    for size in (1, 2, 1000):
        fates = [random.choice((-2, -1, 0, random.randrange(DELAY_US_MAX + 1))) for _ in range(size)]
        text = encode_fates(fates)
        assert decode_fates(text).tolist() == fates
        assert text.isascii()
        assert text.isprintable()
    assert decode_fates(encode_fates([0, DELAY_US_MAX])).tolist() == [0, DELAY_US_MAX]


def test_the_text_is_the_lowest_byte_first_whatever_the_machine() -> None:
    assert zlib.decompress(base64.b64decode(encode_fates([1, -1, 258]))) == (
        b"\x01\0\0\0\xff\xff\xff\xff\x02\x01\0\0"
    )


def test_fates_of_one_kind_take_little_room() -> None:
    assert len(encode_fates([200_000] * 1500)) < 60


@pytest.mark.parametrize("fates", [[], [UNTOUCHED - 1], [0, DELAY_US_MAX + 1]])
def test_what_is_no_fate_is_not_written(fates: list[int]) -> None:
    with pytest.raises(ValueError, match=r"^must be "):
        encode_fates(fates)


def packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data)).decode()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("eNo!", "not base64"),
        ("é", "not base64"),
        ("", "cut short"),
        ("AAAA", "damaged"),
        (base64.b64encode(zlib.compress(b"\0" * 8)[:-2]).decode(), "cut short"),
        (base64.b64encode(zlib.compress(b"\0" * 8) + b"more").decode(), "goes on"),
        (packed(b""), "0 bytes"),
        (packed(b"\0" * 6), "6 bytes"),
        (packed((-3).to_bytes(4, "little", signed=True)), "-3 is neither"),
    ],
)
def test_a_text_that_was_spoilt_is_refused(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=f"^must be fates .*{says}"):
        decode_fates(text)


def test_a_small_text_does_not_become_a_large_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_fates, "FATES_MAX", 100)
    assert len(decode_fates(packed(b"\0" * 400))) == 100
    with pytest.raises(ValueError, match="more than 100 of them"):
        decode_fates(packed(b"\0" * 404))
    with pytest.raises(ValueError, match="got 101"):
        encode_fates([0] * 101)


# --- scenarios --------------------------------------------------------------------------------

FAULTS = """
[faults]
delay = "30ms 20ms"
loss = "20%"
duplicate = "10%"
[[faults.rule]]
link = "1->2"
at = 0.5
for = 0.4
hold = true
[[faults.rule]]
link = "2->3"
corrupt = "20%"
[[faults.rule]]
robot = 3
topic = "wrench"
loss = "10%"
"""


def fates(recording: Recording) -> dict[tuple[Link, int], list[int]]:
    """Delays (us, -1 lost) of every message of the mission, by link and number."""
    out: dict[tuple[Link, int], list[int]] = {}
    for link, rows in recording.links.by_link():
        for sequence, what, delay in zip(
            rows.sequence.tolist(), rows.what.tolist(), rows.delay_us.tolist(), strict=True
        ):
            if sequence >= FIRST_ROUND:
                out.setdefault((link, sequence), []).append(-1 if what & (LOST | CORRUPTED) else delay)
    return out


def test_a_replayed_run_suffers_the_same_message_by_message(tmp_path: Path) -> None:
    first = trio(FAULTS)
    sent = driven(first)
    scenario = write_scenario(leave_run(tmp_path / "run", first, sent))
    assert scenario.startswith("# What became of the messages of ")
    tables = tomllib.loads(scenario)["faults"]["replay"]
    # Those from before the mission was known count from 0, and are left out.
    assert all(FIRST_ROUND - 50 < table["first"] < FIRST_ROUND + 10 for table in tables)
    again = trio(scenario)
    before, after = recorded(first, sent), recorded(again, driven(again))
    wanted, found = fates(before), fates(after)
    assert len(wanted) > 600
    assert any(len(delays) > 1 for delays in wanted.values())
    # How the runs end after the drive is another matter: what is said last differs.
    common = wanted.keys() & found.keys()
    assert len(common) > 0.9 * len(wanted)
    assert {key: found[key] for key in common} == {key: wanted[key] for key in common}
    apart = np.abs(before.hand_positions() - after.hand_positions())
    assert apart.max() < 2e-3  # what came before the mission is not replayed


def test_only_links_with_a_decision_are_in_a_scenario(tmp_path: Path) -> None:
    fleet = trio('[[faults.rule]]\nlink = "1->2"\nloss = "50%"\nat = 0.5\nfor = 0.2\n')
    scenario = tomllib.loads(write_scenario(leave_run(tmp_path, fleet, driven(fleet))))
    (table,) = scenario["faults"]["replay"]
    assert (table["link"], table["topic"]) == ("1->2", "hand")
    assert table["first"] == FIRST_ROUND + 25
    assert len(decode_fates(table["fates"])) == 10
    assert "second" not in table


def test_a_run_without_faults_has_no_scenario(tmp_path: Path) -> None:
    fleet = trio(duration=0.5)
    with pytest.raises(RecordingError, match="has no fates to replay"):
        write_scenario(leave_run(tmp_path, fleet, driven(fleet)))
    with pytest.raises(RecordingError, match="does not exist"):
        write_scenario(tmp_path / "nowhere")
