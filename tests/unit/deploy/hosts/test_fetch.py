"""Recordings that are brought from hosts: what is believed of what a host says, and what stays here."""

from __future__ import annotations

import argparse
import errno
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import tomli_w

from handfast.agent.fleet.loading import to_dict
from handfast.deploy.commands.hosts import fetch as fetch_command
from handfast.deploy.console.arguments import InputError, no_changes
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.fetch import FILES_MAX, NAME_BYTES, Fetching
from handfast.deploy.hosts.jobs import Row
from tests.unit.agent.fleet.test_hosts import HOSTS, fleet

FLEET = fleet(HOSTS)
ROBOT = 1
HOST = FLEET.hosts[0]


def name(number: int, mark: str = "aaaaaaaa") -> str:
    return f"{number:08d}-{mark}.mcap"


class There:
    """A host with a robot's recording; what it answers may be anything."""

    host = HOST

    def __init__(self, **files: bytes) -> None:
        self.files = dict(files)
        self.listing: Callable[[], Any] = lambda: {n: [len(data), 1e9] for n, data in self.files.items()}
        self.before_get: Callable[[str], None] = lambda _: None
        self.sent = 0

    def ask(self, what: str, *, folder: str, pattern: str, most: int, answer_bytes: int) -> Any:
        assert (what, folder, pattern) == ("listing", "fleets/two/recordings/robot-1", "*.mcap")
        assert (most, answer_bytes) == (FILES_MAX, FILES_MAX * NAME_BYTES)
        return self.listing()

    def exchange(
        self, what: str, _: None, *, data_bytes: int, path: str, offset: int, most: int
    ) -> tuple[None, bytes]:
        assert (what, data_bytes) == ("get", most)
        file = path.rpartition("/")[2]
        self.before_get(file)
        if file not in self.files:
            raise HostError(f"no such file or directory {file}")
        data = self.files[file][offset : offset + most]
        self.sent += len(data)
        return None, data


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "handfast/recordings/two/robot-1"


def bring(there: There, since_s: float | None = None) -> tuple[Fetching, Row]:
    work, row = Fetching(FLEET, since_s), Row(HOST.name, (ROBOT,))
    work(there, row)  # type: ignore[arg-type]
    return work, row


def kept(cache: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in cache.iterdir()}


def test_what_is_here_already_is_not_sent_again(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("handfast.deploy.hosts.fetch.PART_BYTES", 4)
    there = There(**{name(1): b"one and more", name(2): b"two"})
    work, row = bring(there)
    assert work.folders == {ROBOT: cache}
    assert kept(cache) == there.files
    there.files[name(2)] += b", grown"
    before = there.sent
    _, row = bring(there)
    assert kept(cache) == there.files
    assert there.sent - before == len(b", grown")
    assert row.step == "fetched 0.0 MB"


def test_only_what_is_new_enough_is_brought(cache: Path) -> None:
    there = There(**{name(1): b"old", name(2): b"new"})
    there.listing = lambda: {name(1): [3, 100.0], name(2): [3, 200.0]}
    bring(there, 150.0)
    assert kept(cache) == {name(2): b"new"}


@pytest.mark.parametrize(
    "bad",
    ["/tmp/evil.mcap", "../00000001-aaaaaaaa.mcap", ".bashrc", "x/00000001-aaaaaaaa.mcap", "",
     "00000001-aaaaaaaa.mcap\n", "\u0661" * 8 + "-aaaaaaaa.mcap"],
)  # fmt: skip
def test_a_host_does_not_choose_where_files_are_written(cache: Path, bad: str) -> None:
    there = There(**{name(1): b"one", bad.rpartition("/")[2]: b"evil"})
    there.listing = lambda: {name(1): [3, 1e9], bad: [4, 1e9]}
    bring(there)
    assert list(kept(cache)) == [name(1)]
    assert [path.name for path in cache.parent.iterdir()] == ["robot-1"]


@pytest.mark.parametrize(
    ("listing", "why"),
    [
        ([], "does not say what robot 1 recorded"),
        (None, "does not say what robot 1 recorded"),
        ({name(1): [-1, 1.0]}, "says nonsense of 00000001"),
        ({name(1): [1.5, 1.0]}, "says nonsense"),
        ({name(1): [10**400, 1.0]}, "says nonsense"),
        ({name(1): 7}, "says nonsense"),
        ({name(1): [1, "now"]}, "says nonsense"),
    ],
)
def test_a_host_that_says_nonsense_is_refused(cache: Path, listing: Any, why: str) -> None:
    there = There()
    there.listing = lambda: listing
    with pytest.raises(HostError, match=why):
        bring(there)
    assert kept(cache) == {}


def test_more_files_than_were_asked_for_are_refused(cache: Path) -> None:
    there = There()
    there.listing = lambda: {name(number): [1, 1e9] for number in range(FILES_MAX + 1)}
    with pytest.raises(HostError, match="says that robot 1 recorded 10001 files, asked for 10000"):
        bring(there)
    assert kept(cache) == {}


def test_a_host_that_gives_drop_by_drop_is_given_up(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each part within its time: it would take days."""
    now_s = 0.0

    def hour(_: str) -> None:
        nonlocal now_s
        now_s += 59.0

    monkeypatch.setattr("handfast.deploy.hosts.fetch.time.monotonic", lambda: now_s)
    monkeypatch.setattr("handfast.deploy.hosts.fetch.PART_BYTES", 4)
    there = There(**{name(1): bytes(100_000)})
    there.before_get = hour
    with pytest.raises(HostError, match="is too slow: less than 20 kB/s came"):
        bring(there)
    assert there.sent < 100


def test_a_disk_that_is_full_here_is_said_to_be_ours(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = There(**{name(1): b"one"})
    bring(there)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    there.files[name(2)] = b"two"
    monkeypatch.setattr("handfast.deploy.hosts.fetch.PART_BYTES", 1)
    there.before_get = full
    work = Fetching(FLEET, None)
    why = rf"this computer cannot keep it in {cache}: No space left on device"
    with pytest.raises(HostError, match=f"^{why}$"):
        work(there, Row(HOST.name, (ROBOT,)))  # type: ignore[arg-type]
    assert (work.fall_back(ROBOT) or "").endswith(why)
    assert work.fetched_before == {ROBOT}


def test_only_what_was_pruned_there_is_removed_here(cache: Path) -> None:
    there = There(**{name(4): b"four", name(5): b"five", name(6): b"six"})
    bring(there)
    del there.files[name(4)]
    bring(there)
    assert sorted(kept(cache)) == [name(5), name(6)]
    card, there.files = there.files, {}
    bring(there)
    assert kept(cache) == card, "an empty listing is a new SD card: these are the only copies"
    there.files = {name(1, "bbbbbbbb"): b"new"}
    bring(there)
    assert sorted(kept(cache)) == [name(1, "bbbbbbbb"), name(5), name(6)]


def test_a_host_that_is_off_leaves_what_was_fetched_before(cache: Path) -> None:
    assert Fetching(FLEET, None).fall_back(ROBOT) is None
    bring(There(**{name(1): b"one"}))
    work = Fetching(FLEET, None)
    warning = work.fall_back(ROBOT)
    assert warning is not None
    assert warning.startswith("what robot 1 recorded is as fetched at 20")
    assert work.folders == {ROBOT: cache}


# --- the command -----------------------------------------------------------------------------------


def options(file: Path, **given: Any) -> argparse.Namespace:
    nothing = {"hosts": [], "out": None, "since": None, "until": None, "all": False, "report": False}
    return argparse.Namespace(**{**no_changes(), **nothing, "fleet": str(file), **given})


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "two.toml"
    path.write_text(tomli_w.dumps(to_dict(FLEET)))
    monkeypatch.setattr(
        "handfast.deploy.hosts.jobs.HostJobs.__enter__", lambda _: pytest.fail("hosts are asked")
    )
    return path


def test_bad_input_is_said_before_any_host_is_asked(file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--until 1 h must be later than --since 10 min"):
        fetch_command._fetch(options(file, since="10 min", until="1 h"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(InputError, match="full is not an empty folder"):
        fetch_command._fetch(options(file, out=str(tmp_path / "full")))


def test_ctrl_c_ends_the_merging(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def merging(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it goes on")

    class Jobs:
        rows: ClassVar[dict[str, Row]] = {}

        def __init__(self, _fleet: object, _hosts: object, work: Fetching) -> None:
            work.folders[ROBOT] = Path()

        def __enter__(self) -> Jobs:
            return self

        def __exit__(self, *_: object) -> None: ...

        def wait(self, *_: object) -> None: ...

    monkeypatch.setattr("handfast.deploy.hosts.jobs.HostJobs", Jobs)
    monkeypatch.setattr("handfast.deploy.merging.merge.merge", merging)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` leaves it ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            fetch_command._fetch(options(file))
    finally:
        signal.signal(signal.SIGINT, before)
