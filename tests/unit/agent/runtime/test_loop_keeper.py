"""What a process recalls of orders that were kept: by whichever version of this program."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import msgpack
import pytest

from handfast.agent.messages.codec import VERSION, encode
from handfast.agent.messages.types import Stop
from handfast.agent.node import Node
from handfast.agent.runtime.loop import OrderKeeper
from handfast.agent.runtime.order_store import OrderStore, packed
from handfast.agent.transport.bus import Bus
from tests.wire import sealed

pytestmark = pytest.mark.patches


class Recalling:
    """A node that notes what it is to recall."""

    recalled: Sequence[bytes] = ()

    def recall(self, _now_ns: int, orders: Sequence[bytes]) -> None:
        self.recalled = orders


class PlainBus:
    def opened(self, came: bytes) -> bytes:
        return came


def test_what_another_version_has_kept_is_left_out_and_said(tmp_path: Path) -> None:
    """Else a robot that was upgraded would never start again."""
    log: list[str] = []
    node, stop = Recalling(), encode(Stop(3, 3, "lunch"))
    other = sealed(msgpack.packb([VERSION + 1, 0, 2]))
    with OrderStore(tmp_path / "orders", 1, "agent", log.append) as store:
        (tmp_path / "orders" / "robot-1-agent.json").write_bytes(packed([other, b"nonsense", stop]))
        keeper = OrderKeeper(cast(Node, node), cast(Bus, PlainBus()), store, "two", log.append)
        keeper.recall(1)
    assert node.recalled == [stop]
    assert len(log) == 2
    assert f"version {VERSION + 1}, this program speaks {VERSION}" in log[0]
