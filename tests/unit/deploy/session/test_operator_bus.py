"""An operator who cannot take part in a secured fleet: what is wrong, and what would help."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.credentials import load, load_whenever
from handfast.agent.security.identity import Identity, of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.operator_credentials import AUTHORITY_FILE, KEYS, OPERATOR, earlier_folders
from handfast.deploy.session import operator_bus as module
from handfast.deploy.session.operator_bus import JOINED_RETRY_MS, operator_bus
from tests.trusted import authority, credentials
from tests.unit.deploy.orders.order_fleets import square

ADVICE = "; `handfast keys` makes one (on another computer than the authority's: --request)"


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Fleet:
    """A secured one, whose operator's keys are in `keys` of the test's folder."""
    monkeypatch.setenv(KEYS, str(tmp_path / "keys"))
    monkeypatch.delenv(OPERATOR, raising=False)
    made = square()
    return replace(made, network=replace(made.network, security="tls"))


def refusal(fleet: Fleet) -> str:
    with pytest.raises(InputError) as caught:
        operator_bus(fleet)
    return str(caught.value)


def test_keys_are_advised_where_there_are_none(fleet: Fleet) -> None:
    assert refusal(fleet).endswith(ADVICE)


def test_keys_that_others_may_read_are_not_to_be_made_again(fleet: Fleet, tmp_path: Path) -> None:
    now_s = time.time()
    with authority(tmp_path / "authority", now_s, fleet.fleet.name) as by:
        own = credentials(by, tmp_path / "keys", of_operator(fleet.fleet.name, "main"), now_s=now_s)
    own.files.key.chmod(0o644)
    text = refusal(fleet)
    assert "chmod 600" in text
    assert ADVICE not in text
    own.files.certificate.unlink()
    assert refusal(fleet).endswith(ADVICE)


class Opened:
    """Stands for a bus with the credentials in a folder."""

    def __init__(self, folder: Path, retry_ms: tuple[int, int] | None) -> None:
        self.folder, self.retry_ms, self.is_closed = folder, retry_ms, False

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Opened]:
    """The buses that are opened; with credentials that cannot be used none is."""
    found: list[Opened] = []

    def bus_for(
        _: Fleet,
        identity: Identity,
        folder: Path,
        *__: object,
        retry_ms: tuple[int, int] | None = None,
        whenever: bool = False,
        **___: object,
    ) -> Opened:
        if whenever:
            load_whenever(folder, identity)
        else:
            load(folder, identity, time.time())
        found.append(Opened(folder, retry_ms))
        return found[-1]

    monkeypatch.setattr(module, "bus_for", bus_for)
    return found


@pytest.fixture
def replaced(fleet: Fleet, tmp_path: Path) -> tuple[Path, Path]:
    """The folder of the keys after the authority in it was replaced, and where what was in use is kept."""
    now_s, folder = time.time(), tmp_path / "keys"
    me = of_operator(fleet.fleet.name, "main")
    with authority(folder, now_s, fleet.fleet.name) as by:
        credentials(by, folder, me, now_s=now_s)
        by.replace(now_s)
        credentials(by, folder, me, now_s=now_s)
    (kept,) = earlier_folders(folder)
    return folder, kept


def test_with_one_authority_there_is_one_bus(fleet: Fleet, made: list[Opened], tmp_path: Path) -> None:
    now_s, folder = time.time(), tmp_path / "keys"
    with authority(folder, now_s, fleet.fleet.name) as by:
        credentials(by, folder, of_operator(fleet.fleet.name, "main"), now_s=now_s)
    assert operator_bus(fleet) is made[0]  # type: ignore[comparison-overlap]
    assert [each.retry_ms for each in made] == [None]


def test_one_that_is_not_valid_now_is_tried_where_robots_are_to_judge(
    fleet: Fleet, made: list[Opened], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The authority is elsewhere: nobody renews it here."""
    then_s, folder = time.time() - 400 * DAY_S, tmp_path / "keys"
    with authority(folder, then_s, fleet.fleet.name) as by:
        credentials(by, folder, of_operator(fleet.fleet.name, "main"), now_s=then_s)
    (folder / AUTHORITY_FILE).unlink()
    assert "expired" in refusal(fleet)
    operator_bus(fleet, whenever=True)
    assert [each.folder for each in made] == [folder]
    assert "expired" in capsys.readouterr().err


def test_until_every_robot_has_the_new_one_there_are_two(
    fleet: Fleet, made: list[Opened], replaced: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    bus = operator_bus(fleet)
    assert [each.folder for each in made] == [*replaced]
    assert {each.retry_ms for each in made} == {JOINED_RETRY_MS}
    assert capsys.readouterr().err == f"handfast: {module.BOTH}\n"
    bus.close()
    assert all(each.is_closed for each in made)


def test_what_was_cut_short_leaves_those_of_before_in_use(
    fleet: Fleet, made: list[Opened], replaced: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """The new authority is there, and no certificate of it yet."""
    folder, kept = replaced
    next(folder.glob("*.operator.main.crt")).unlink()
    operator_bus(fleet)
    assert [each.folder for each in made] == [kept]
    assert f"{ADVICE}\n" in capsys.readouterr().err


def test_credentials_of_before_that_cannot_be_used_keep_nobody(
    fleet: Fleet, made: list[Opened], replaced: tuple[Path, Path]
) -> None:
    folder, kept = replaced
    next(kept.glob("*.operator.main.crt")).unlink()
    operator_bus(fleet)
    assert [each.folder for each in made] == [folder]
    next(folder.glob("*.operator.main.crt")).unlink()
    assert refusal(fleet).endswith(ADVICE)


def test_that_each_robot_refuses_one_of_the_two_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    for why in ("it does not know the authority of our certificate", "its certificate has expired"):
        module._log_joined(f"refused: the connection to tls/10.0.0.1:7600: {why} (3 times)")
    (said,) = capsys.readouterr().err.splitlines()
    assert said.endswith("tls/10.0.0.1:7600: its certificate has expired (3 times)")


def test_when_it_has_expired_it_is_to_be_renewed(fleet: Fleet, tmp_path: Path) -> None:
    past_s = time.time() - 400 * 86_400
    with authority(tmp_path / "authority", past_s, fleet.fleet.name) as by:
        credentials(by, tmp_path / "keys", of_operator(fleet.fleet.name, "main"), now_s=past_s)
    assert "expired 35 days ago; `handfast keys` renews it" in refusal(fleet)
