"""The bus of a secured fleet: while no router answers, and for who keeps the seals of orders."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Stop
from handfast.agent.security.identity import MAIN, of_operator, of_robot
from handfast.agent.security.refusals import Refusals
from handfast.agent.security.sealed_order import Sealer
from handfast.agent.transport import sealed_bus
from handfast.agent.transport.bus import Bus, BusError
from handfast.agent.transport.sealed_bus import SealedBus
from tests.process.guarded import guarded_fleet
from tests.trusted import FLEET, authority, credentials

pytestmark = pytest.mark.patches

LINE = (
    b"DEBUG ThreadId(02) zenoh::net::runtime::orchestrator: Unable to connect to configured router "
    b"tls/10.0.0.9:7447! invalid peer certificate: not valid for name\n"
)


class Log:
    """Stands for `ZenohLog`: somebody refuses us all the while."""

    def __init__(self) -> None:
        self.refusals = Refusals()
        self.closed = False

    def lines(self, now_ns: int) -> Iterator[str]:
        self.refusals.take(LINE)
        return self.refusals.lines(now_ns)

    def close(self) -> None:
        self.closed = True


def test_why_no_router_answers_is_said_while_it_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    asked: list[list[str]] = []

    def no_router(_bus: Bus, *, go_on_waiting: Callable[[], bool], **_: Any) -> None:
        while go_on_waiting():
            pass
        raise BusError("no router answers")

    def go_on() -> bool:
        asked.append(list(said))
        return len(asked) < 3

    now_s = time.time()
    with authority(tmp_path / "authority", now_s) as by:
        credentials(by, tmp_path / "one", of_robot(FLEET, 1), now_s=now_s)
    monkeypatch.setattr(sealed_bus, "ZenohLog", Log)
    monkeypatch.setattr(sealed_bus, "init_log", lambda _: None)
    monkeypatch.setattr(Bus, "__init__", no_router)
    with pytest.raises(BusError, match="no router answers"):
        SealedBus(guarded_fleet(), tmp_path / "one", of_robot(FLEET, 1), said.append, go_on_waiting=go_on)
    assert asked[0] == [
        "refused: the connection to tls/10.0.0.9:7447: its certificate is for other addresses"
    ]
    assert len(asked) == 3


@pytest.mark.parametrize("keep_seals", [False, True])
def test_who_keeps_evidence_gets_orders_as_they_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep_seals: bool
) -> None:
    """What is no operator's is left out in any case."""
    now_s = time.time()
    with authority(tmp_path / "authority", now_s) as by, authority(tmp_path / "other", now_s) as other:
        credentials(by, tmp_path / "one", of_robot(FLEET, 1), now_s=now_s)
        ann = credentials(by, tmp_path / "ann", of_operator(FLEET, MAIN), now_s=now_s)
        eve = credentials(other, tmp_path / "eve", of_operator(FLEET, MAIN), now_s=now_s)
    order, told = encode(Stop(3, round(now_s * 1e9), "lunch")), key_expressions.relayed(FLEET, 1)
    sealed, forged = (Sealer(who).seal(order, round(now_s * 1e9)) for who in (ann, eve))
    came = [(told, sealed), (told, forged), (told, order), (key_expressions.hand(FLEET, 1), b"hand")]
    monkeypatch.setattr(sealed_bus, "ZenohLog", Log)
    monkeypatch.setattr(sealed_bus, "init_log", lambda _: None)
    monkeypatch.setattr(Bus, "__init__", lambda *_, **__: None)
    monkeypatch.setattr(Bus, "close", lambda _: None)
    monkeypatch.setattr(Bus, "drain", lambda _: iter(came))
    identity = of_robot(FLEET, 1)
    with SealedBus(guarded_fleet(), tmp_path / "one", identity, lambda _: None, keep_seals=keep_seals) as bus:
        assert list(bus.drain()) == [(told, sealed if keep_seals else order), came[-1]]
