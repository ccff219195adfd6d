"""Orders as robots take them from a file: sealed as the fleet's gate takes them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Stop
from handfast.deploy.console.arguments import InputError
from handfast.deploy.session.operator_bus import sealed
from tests.unit.deploy.orders.order_fleets import square

FLEET = square()


def test_of_a_fleet_that_is_not_secured_as_it_is() -> None:
    assert sealed(FLEET, b"order") == b"order"


def test_without_a_key_it_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HANDFAST_KEYS", str(tmp_path))
    secured = replace(FLEET, network=replace(FLEET.network, security="on"))
    assert secured.is_secured
    with pytest.raises(InputError, match=str(tmp_path)):
        sealed(secured, encode(Stop(1, 1, "")))
