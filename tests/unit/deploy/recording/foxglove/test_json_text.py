"""Texts of JSON: a time, and where it belongs."""

from __future__ import annotations

import json

from handfast.deploy.recording.foxglove.json_text import STAMP, dumps, stamped, time


def test_a_stamp_becomes_the_time_and_a_text_that_holds_one_stays_as_it_is() -> None:
    content = '{"at":' + STAMP + ',"text":' + dumps(f"a{STAMP}b") + "}"
    assert json.loads(stamped(content, 3_000_000_007)) == {"at": {"sec": 3, "nsec": 7}, "text": "a\0b"}


def test_times_before_1970_have_no_negative_nanoseconds() -> None:
    assert json.loads(time(-1)) == {"sec": -1, "nsec": 999_999_999}
