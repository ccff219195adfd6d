"""`handfast drive`: what it does not take, said in one line before anything is sent."""

from __future__ import annotations

import os
import re
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from handfast.agent.runtime.order_store import NotPrivateError
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_operator, of_robot
from handfast.agent.transport.bus import BusError
from handfast.deploy.cli import main
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from handfast.deploy.inventory.operator_credentials import KEYS
from handfast.deploy.processes.placement import Reservation
from handfast.deploy.recording.mcap_reader import read_run
from handfast.deploy.recording.run_files import RecordingError
from tests.process.fleet_harness import BASE_PORT
from tests.trusted import authority, credentials

PAIR = (FLEETS / "pair.toml").read_text()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 2) -> str:
    assert main(["drive", *arguments]) == status
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, err
    return lines[0].removeprefix("handfast: ")


def file(folder: Path, more: str) -> str:
    path = folder / "fleet.toml"
    path.write_text(PAIR + more)
    return str(path)


@pytest.mark.parametrize("option", ["--set", "--law", "--seed", "--faults"])
def test_what_would_change_what_robots_have_read(capsys: pytest.CaptureFixture[str], option: str) -> None:
    assert refused(capsys, "pair", option, "1") == (
        f"drive: {option} changes the fleet file, which the robots have read already: bring them up with it "
        f"(`handfast up FLEET {option} ...`), or drive it here with `handfast run`"
    )


def test_process_faults_are_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    rules = '[[faults.rule]]\nname = "crash"\nrobot = 1\nat = 2\nrestart = "agent"\n'
    assert refused(capsys, file(tmp_path, rules)).endswith(
        "the fault rules 'crash' kill, pause or restart processes, which only `handfast run` and `simulate` "
        "do"
    )


@pytest.mark.parametrize(
    ("more", "arguments", "text"),
    [
        ("", ("--out", "here"), "--out: there is no folder with --detach: nobody records"),
        (
            "[supervision]\ndeadman_s = 1.5\n",
            (),
            "--detach: pair has a dead-man's switch (supervision.deadman_s = 1.5): its robots hold without "
            "an operator's heartbeat",
        ),
        (
            '[[order]]\nat = 3\nkind = "stop"\n[[order]]\nat = 4.5\nkind = "resume"\n',
            (),
            "--detach: nobody would give the orders at 3 s (stop), 4.5 s (resume)",
        ),
    ],
)
def test_what_nobody_would_do_after_detach(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, more: str, arguments: tuple[str, ...], text: str
) -> None:
    assert refused(capsys, file(tmp_path, more), "--detach", *arguments) == text


def test_bad_orders_and_durations_are_found_before_a_robot_is_asked(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["drive", "pair", "--duration=-3s"]) == 2
    assert "fleet.duration_s" in capsys.readouterr().err
    orders = tmp_path / "orders.toml"
    orders.write_text('[[order]]\nat = 1\nkind = "dance"\n')
    assert main(["drive", "pair", "--orders", str(orders)]) == 2
    assert "dance" in capsys.readouterr().err


def test_a_fleet_that_is_not_up(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ports = Reservation("127.0.0.1", BASE_PORT, 4)
    try:
        (tmp_path / "fleet.toml").write_text(re.sub("base_port = .*", f"base_port = {ports.base}", PAIR))
        said = refused(capsys, "fleet.toml", status=1)
    finally:
        ports.close()
    assert said.startswith("fleet pair does not answer: none of its 4 agents and plants is there")
    assert not (tmp_path / "runs").exists()


class Drives:
    """Stands for a `Drive` that is over at once."""

    end_ns = time.time_ns() + 10**9
    reasons: list[str]

    def __init__(self, *_: object, **__: object) -> None:
        self.reasons = [] if self.is_left else ["It failed."]

    is_left = True

    def run(self, *, detach: bool = False) -> None: ...


@pytest.fixture
def drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A fleet that is up and lets itself be driven; its folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("handfast.deploy.drive.attached.refused", lambda *_, **__: "")
    monkeypatch.setattr("handfast.deploy.session.operator_bus.operator_bus", lambda _: nullcontext())
    monkeypatch.setattr("handfast.deploy.drive.drive.Drive", Drives)
    return tmp_path


@pytest.mark.parametrize("interrupts", [0, 1])
def test_robots_that_drive_alone_are_told_of_whatever_happened(
    drives: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, interrupts: int
) -> None:
    monkeypatch.setattr(Drives, "run", lambda *_, **__: [os.kill(os.getpid(), 2) for _ in range(interrupts)])
    (drives / "my pair.toml").write_text(PAIR)
    assert main(["drive", "my pair.toml", "--detach", "--quiet"]) == (130 if interrupts else 0)
    assert re.fullmatch(
        r"pair drives until \d\d:\d\d:\d\d; `handfast stop 'my pair.toml'` stops it\n",
        capsys.readouterr().out,
    )
    monkeypatch.setattr(Drives, "is_left", False)
    assert main(["drive", "my pair.toml", "--detach", "--quiet"]) == (130 if interrupts else 1)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError(28, "No space left on device", "/x/run-1"), "not started: cannot write /x/run-1: No space"),
        (NotPrivateError("/x must be a folder of this user"), "/x must be a folder of this user"),
        (InputError("no certificate"), "no certificate"),
    ],
)
def test_a_drive_that_cannot_begin_leaves_a_complete_recording(
    drives: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    says: str,
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise error

    place = (
        "handfast.deploy.session.operator_bus.operator_bus"
        if type(error) is InputError
        else "handfast.deploy.inventory.registry.Registration"
    )
    monkeypatch.setattr(place, fails)
    assert refused(capsys, "pair", "--out", "out", "--quiet").startswith(says)
    assert is_complete(drives / "out")


def test_a_drive_that_breaks_off_leaves_a_complete_recording(
    drives: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Drives, "run", fails)
    with pytest.raises(ZeroDivisionError):
        main(["drive", "pair", "--out", "out", "--quiet"])
    assert is_complete(drives / "out")
    monkeypatch.setattr(Drives, "run", disconnected)
    assert refused(capsys, "pair", "--out", "more", "--quiet", status=1) == "the bus is gone"
    assert is_complete(drives / "more")


def disconnected(*_: object, **__: object) -> None:
    raise BusError("the bus is gone")


def is_complete(folder: Path) -> bool:
    """Whether the recording of a drive in which nothing was heard was brought to its end."""
    with pytest.raises(RecordingError, match=r"holds no message") as caught:
        read_run(folder)
    return "cut short" not in str(caught.value)


def test_certificates_that_end_soon_are_warned_of_before_it_begins(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEYS, str(tmp_path / "keys"))
    monkeypatch.setattr("handfast.deploy.session.session.CONNECT_S", 0.1)
    made_s = time.time() - (CERTIFICATE_DAYS - 19.5) * DAY_S
    with authority(tmp_path / "keys", made_s, "pair") as by:
        credentials(by, tmp_path / "keys", of_operator("pair"), now_s=made_s)
        credentials(by, tmp_path / "robot", of_robot("pair", 2), now_s=made_s)
    secured = PAIR.replace("[network]", '[network]\nsecurity = "mtls"')
    (tmp_path / "fleet.toml").write_text(secured)
    path = str(tmp_path / "fleet.toml")
    assert main(["drive", path]) == 1
    warned = [line for line in capsys.readouterr().err.splitlines() if "certificate" in line]
    assert warned == [
        f"warning: the certificate of operator main expires in 19 days: `handfast keys {path}` renews it",
        f"warning: the certificate of robot 2 expires in 19 days: `handfast up {path}` renews it",
    ]
