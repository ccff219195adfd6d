"""`handfast keys --signing`: key files, and what it refuses before any vehicle is spoken to."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from handfast.bridges.mavlink.session.identity import load_key
from handfast.deploy.cli import main
from handfast.deploy.commands.hosts.signing import prepare_keys
from tests.rover_scene import rovers

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`handfast keys rovers --signing ...`: exit status, output, errors."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def signing(*arguments: str) -> tuple[int, str, str]:
        status = main(["keys", "rovers", "--signing", *arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return signing


def key_of(robot: int, path: Path) -> str:
    return f'--set=robot.{robot}.mavlink.signing_key="{path}"'


def at(robot: int, connection: str) -> str:
    return f'--set=robot.{robot}.mavlink.connection="{connection}"'


def test_keys_are_made_once_and_for_this_user_only(tmp_path: Path) -> None:
    path = tmp_path / "new" / "key"
    where = [f'robot_defaults.mavlink.signing_key="{path}"']
    robots = rovers(*where).robots[:2]
    prepare_keys(robots, make=True)
    key = load_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    prepare_keys(robots, make=True)
    assert load_key(path) == key


def test_a_key_is_never_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "key"
    prepare_keys(rovers(f'robot.1.mavlink.signing_key="{path}"').robots[:1], make=True)
    said = capsys.readouterr()
    assert said.out == f"robot 1: made {path}: keep a copy, its ground station needs it too\n"
    assert load_key(path).hex() not in said.out + said.err


def test_what_cannot_be_used_or_made_is_bad_input(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "key"
    elsewhere = at(1, "tcp:127.0.0.1:9")
    assert run(elsewhere, key_of(1, path)) == (
        2,
        "",
        f"handfast: robot 1: there is no signing key {path}: --make-keys makes one\n",
    )
    assert not path.exists()
    path.write_text("no key")
    path.chmod(0o600)
    status, _, error = run(elsewhere, key_of(1, path), "--make-keys")
    assert (status, path.read_text()) == (2, "no key")
    assert f"robot 1: the signing key {path} must be 32 bytes" in error
    path.chmod(0o644)
    assert f"chmod 600 {path}" in run(elsewhere, key_of(1, path))[2]
    status, _, error = run(elsewhere, key_of(1, path / "below" / "key"), "--make-keys")
    assert (status, error) == (
        2,
        f"handfast: robot 1: cannot make the folder {path}/below: not a directory\n",
    )
    dangling = tmp_path / "link"
    dangling.symlink_to(tmp_path / "gone")
    status, _, error = run(elsewhere, key_of(1, dangling), "--make-keys")
    assert (status, "the signing key: cannot read" in error) == (2, True)


def test_who_is_meant_must_be_there_and_have_a_key(run: Run, tmp_path: Path) -> None:
    status, _, error = run("--robot=9")
    assert status == 2
    assert "there is no robot 9" in error
    status, _, error = run()
    assert status == 2
    assert "no robot that is meant has mavlink.signing_key" in error
    assert run(key_of(1, tmp_path / "key"), "--robot=2")[0] == 2


def test_simulated_rovers_and_those_without_a_key_are_left_alone(run: Run, tmp_path: Path) -> None:
    """The rovers of that fleet are simulated: nothing is opened, and no key is made."""
    path = tmp_path / "key"
    status, out, error = run(key_of(2, path), "--robot=1", "--robot=2", "--make-keys")
    assert status == 1
    assert error == ""
    assert out.splitlines() == [
        "robot 1: no mavlink.signing_key in the fleet file: left alone",
        "robot 2: NOT DONE: `run` and `preflight` start its simulated rover, and always without a key: leave "
        "signing_key out, or start one by `handfast rover-simulator` and name its place as the connection",
    ]
    assert not path.exists()


def test_a_timestamp_that_cannot_be_kept_is_bad_input_and_leaves_nothing_open(
    run: Run, tmp_path: Path
) -> None:
    """Robot 1's thread has begun by then."""
    path = tmp_path / "key"
    (tmp_path / "state" / "handfast" / "signing-rovers-2").mkdir(parents=True)
    before = threading.active_count()
    status, _, error = run(
        *(at(robot, f"udpin:127.0.0.1:{port}") for robot, port in ((1, 24_991), (2, 24_992))),
        *(key_of(robot, path) for robot in (1, 2)),
        "--make-keys",
    )
    assert status == 2
    assert "robot 2: cannot keep the signing timestamp: " in error
    assert threading.active_count() == before


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("--signing", "--renew"),
            "--signing takes --robot and --make-keys only: leave out --renew",
        ),
        (("--make-keys",), "--make-keys and several --robot belong to --signing"),
        (("--robot=1", "--robot=2"), "--make-keys and several --robot belong to --signing"),
    ],
)
def test_options_of_certificates_and_of_signing_are_not_mixed(
    arguments: tuple[str, ...], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["keys", "rovers", *arguments]) == 2
    assert capsys.readouterr().err == f"handfast: {says}\n"
