"""An operator who cannot take part in a secured fleet: what is wrong, and what would help."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_operator
from handfast.deploy.console.arguments import InputError
from handfast.deploy.inventory.operator_credentials import KEYS, OPERATOR
from handfast.deploy.session import operator_bus as module
from handfast.deploy.session.operator_bus import operator_bus
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


def test_one_that_is_not_valid_now_is_tried_where_robots_are_to_judge(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[Path] = []
    monkeypatch.setattr(
        module, "bus_for", lambda _fleet, _identity, folder, _log, **_settings: made.append(folder)
    )
    then_s, folder = time.time() - 400 * DAY_S, tmp_path / "keys"
    with authority(folder, then_s, fleet.fleet.name) as by:
        credentials(by, folder, of_operator(fleet.fleet.name, "main"), now_s=then_s)
    assert "expired" in refusal(fleet)
    operator_bus(fleet, whenever=True)
    assert made == [folder]
    assert "expired" in capsys.readouterr().err


def test_when_it_has_expired_it_is_to_be_renewed(fleet: Fleet, tmp_path: Path) -> None:
    past_s = time.time() - 400 * 86_400
    with authority(tmp_path / "authority", past_s, fleet.fleet.name) as by:
        credentials(by, tmp_path / "keys", of_operator(fleet.fleet.name, "main"), now_s=past_s)
    assert "expired 35 days ago; `handfast keys` renews it" in refusal(fleet)
