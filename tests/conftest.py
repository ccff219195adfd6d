"""What holds for every test: order, randomness, no skips in CI, no process left behind."""

from __future__ import annotations

import os
import secrets
import signal
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import hypothesis
import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling, LoadScopeScheduling

HERE = Path(__file__).parent
PROCESS_FOLDERS = ("hosts", "process")  # every test in them starts processes; the longest first
MAY_SKIP = ("autopilot",)
ORDER = ("", "slow", "process", "autopilot")  # quick tests first, so that a plain mistake shows at once
MARK_VARIABLE = "HANDFAST_TEST_PROCESS"  # in the environment of whatever a test starts
GRACE_S = 2.0  # how long a process that was told to stop may take to be gone
NO_SKIPS = os.environ.get("HANDFAST_NO_SKIPS") == "1"  # set by .ci/run

# As in `deploy.cli.process`: OpenBLAS's threads spin for each other where tests share the processors.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
hypothesis.settings.register_profile("dev", deadline=None, print_blob=True)


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Choose hypothesis's profile, and a seed that can be given again, unless the caller did."""
    if config.getoption("--hypothesis-profile") is None:
        profile = "ci" if os.environ.get("CI") else "dev"
        hypothesis.settings.load_profile(profile)
        if profile == "dev" and config.getoption("--hypothesis-seed") is None:
            config.option.hypothesis_seed = str(secrets.randbits(32))  # xdist hands it to its workers


def pytest_report_header(config: pytest.Config) -> str:
    """Say how the run's random examples can be had again."""
    seed = config.getoption("--hypothesis-seed")
    if seed is None:
        return "random examples: the same in every run"
    return f"random examples: seed {seed}; again with --hypothesis-seed={seed}"


@pytest.hookimpl(optionalhook=True)  # with -p no:xdist nobody knows it
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling | None:
    """With --dist loadfile: modules side by side, but one set of test hosts at a time."""
    return OneSetOfHosts(config, log) if config.getoption("dist") == "loadfile" else None


class OneSetOfHosts(LoadFileScheduling):
    """Gives all tests of tests/hosts to one worker."""

    def _split_scope(self, nodeid: str) -> str:
        scope: str = super()._split_scope(nodeid)
        return "tests/hosts" if scope.startswith("tests/hosts/") else scope


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of the folders that start processes; order by marker, else as written."""
    for item in items:
        if _process_folder(item) is not None:
            item.add_marker(pytest.mark.process)
    items.sort(key=_place)


def _process_folder(item: pytest.Item) -> int | None:
    """Which of `PROCESS_FOLDERS` the test stands in."""
    folder = item.path.relative_to(HERE).parts[0] if item.path.is_relative_to(HERE) else ""
    return PROCESS_FOLDERS.index(folder) if folder in PROCESS_FOLDERS else None


def _place(item: pytest.Item) -> tuple[int, int]:
    folder = _process_folder(item)
    if folder is not None:  # those of a module together
        return ORDER.index("process"), folder
    return max(ORDER.index(name) if item.get_closest_marker(name) else 0 for name in ORDER), 0


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Turn a skip into a failure where everything must run."""
    report = yield
    may_skip = any(item.get_closest_marker(name) for name in MAY_SKIP)
    if report.skipped and not hasattr(report, "wasxfail") and not may_skip:
        _refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Likewise for a module that skips itself while it is collected."""
    report = yield
    if report.skipped:
        _refuse_skip(report)
    return report


def _refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    if NO_SKIPS:
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        report.outcome = "failed"
        report.longrepr = f"skipped where every test must run (HANDFAST_NO_SKIPS=1): {reason}"


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_is_heard() -> Iterator[None]:
    """Undo that Ctrl-C is ignored, as in what a script starts with ``&``: processes would inherit that."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def no_process_left_behind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test that leaves a process running, and kill it.

    Linux only (elsewhere it does nothing). A process that fixtures of a wider scope started
    before the test is not the test's. Found are descendants of this process and, for tests
    marked `process`, orphans that inherited its environment.
    """
    if not Path("/proc/self/task").exists():
        yield
        return
    marked = f"{MARK_VARIABLE}={os.getpid()}-{secrets.token_hex(8)}"
    orphans = request.node.get_closest_marker("process") is not None
    if orphans:
        monkeypatch.setenv(*marked.split("=", 1))
    before = _descendants()
    yield
    deadline = time.monotonic() + GRACE_S
    while left := (_descendants() | (_marked(marked) if orphans else set())) - before:
        if time.monotonic() > deadline:
            break
        time.sleep(0.01)
    told = [f"{pid}: {_command(pid)}" for pid in sorted(left)]
    for pid in left:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
    if told:
        pytest.fail("left running (now killed):\n  " + "\n  ".join(told), pytrace=False)


def _descendants() -> set[int]:
    """Running processes below this one, without the helpers that Python itself keeps."""
    found: set[int] = set()
    parents = [os.getpid()]
    while parents:
        for listing in Path(f"/proc/{parents.pop()}/task").glob("*/children"):
            for pid in map(int, _read(listing).split()):
                parents.append(pid)
                if _running(pid) and not _is_pythons_own(pid):
                    found.add(pid)
    return found


def _is_pythons_own(pid: int) -> bool:
    """Return True for the helper that `multiprocessing` keeps until the process that started it ends."""
    return "multiprocessing.resource_tracker" in _command(pid)


def _marked(environment: str) -> set[int]:
    """Running processes that were started with this line in their environment."""
    wanted = environment.encode()
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and wanted in _read(entry / "environ").split(b"\0"):
            found.add(int(entry.name))
    return {pid for pid in found if _running(pid) and not _is_pythons_own(pid)}


def _running(pid: int) -> bool:
    state = _read(Path(f"/proc/{pid}/stat")).rpartition(b")")[2].split()
    return bool(state) and state[0] not in (b"Z", b"X")  # a zombie only waits for its parent to ask


def _command(pid: int) -> str:
    return _read(Path(f"/proc/{pid}/cmdline")).replace(b"\0", b" ").decode(errors="replace").strip()


def _read(path: Path) -> bytes:
    """Contents of a file under /proc, nothing when its process is gone or not ours."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


@pytest.fixture(autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What commands remember for the next ones is each test's own; the folder is made when it is needed."""
    folder = tmp_path_factory.getbasetemp() / f"state-{secrets.token_hex(6)}"
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
