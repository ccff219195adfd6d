"""What others see as a process's command line. Each test has a process of its own to overwrite it in."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from handfast.deploy.processes import attributes

SHOWS = """
import sys
from handfast.deploy.processes import attributes
attributes.show({words})
print(end=open("/proc/self/cmdline").read())
"""


def shown(words: str, more: str) -> subprocess.CompletedProcess[str]:
    program = SHOWS.format(words=words)
    return subprocess.run([sys.executable, "-c", program, more], capture_output=True, text=True)


def test_a_process_is_seen_under_other_words_and_nothing_is_left_of_its_own() -> None:
    words = ["python", "-m", "handfast.agent", "--fleet", "/tmp/Münster/fleet.toml"]
    done = shown(repr(words), "x" * 500)
    assert done.stdout.rstrip("\0").split("\0") == words, done.stderr
    assert len(done.stdout.encode()) > 500, "the area is as large as it was"


def test_what_does_not_fit_is_refused() -> None:
    done = shown("['w' * 5000]", "x")
    assert "ValueError: a command line of 5001 bytes does not fit into" in done.stderr


def test_the_room_of_words_counts_their_bytes_and_ends() -> None:
    assert attributes.room(["ab", "é", ""]) == 3 + 3 + 1


@pytest.mark.parametrize("text", ["", "1 (a b) S 2", "1 (x) " + "0 " * 60])
def test_where_the_kernel_does_not_tell_there_is_no_room(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "read_text", lambda _: text)
    assert attributes.area() == (0, 0)
    with pytest.raises(ValueError, match="does not fit into 0"):
        attributes.show(["a"])
