"""What several robots say, in one message (PURE).

Most of what a message costs is that a process wakes for it, whatever it holds. So where robots are linked to
routers these pass beacons on in batches, and in a crowd on one machine hand states, too
(`agent.runtime.batcher`): each as its robot said it, byte by byte.

A batch is one MessagePack array ``[id, bytes, id, bytes, ...]``. What is in it is looked at by whoever takes
it, as if it had come alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgpack

from handfast.agent.messages.types import BYTES_MAX
from handfast.agent.messages.validation import Malformed

BATCH_BYTES: Final = 49_152
"""A batch is no larger than this and one message, which links let through."""
EACH_MAX: Final = 4
"""So many messages of each robot are in one batch at most, on average."""
_FRAME_BYTES: Final = 8
"""Of an id and of the length of what follows, at most."""

_pack = msgpack.Packer(use_bin_type=True, autoreset=True).pack


def packed(said: Iterable[tuple[int, bytes]], robots: int) -> list[bytes]:
    """As few batches as hold what robots have said, (id, payload), in this order; an empty one where there is
    nothing.

    Args:
        robots: how many there are; whatever one of them says, `unpacked` takes each batch.
    """
    batches: list[bytes] = []
    row: list[int | bytes] = []
    size = 0
    for robot, payload in said:
        if size >= BATCH_BYTES or len(row) >= 2 * EACH_MAX * robots:
            batches.append(_pack(row))
            row, size = [], 0
        row += (robot, payload)
        size += len(payload) + _FRAME_BYTES
    if row or not batches:
        batches.append(_pack(row))
    return batches


def unpacked(batch: bytes, robots: int, keys: Mapping[int, str]) -> list[tuple[str, bytes]]:
    """What is in a batch, (key, payload).

    Args:
        robots: how many there are.
        keys: on which each robot says it; of others nothing is taken.

    Raises:
        Malformed: it is no batch.
    """
    most = EACH_MAX * robots
    try:
        row: Any = msgpack.unpackb(batch, use_list=False, max_array_len=2 * most, max_bin_len=BYTES_MAX)
    except Exception as error:  # msgpack raises a dozen unrelated types; each means the same here
        raise Malformed("malformed", f"not a batch of at most {most} ({type(error).__name__})") from None
    if type(row) is not tuple or len(row) % 2:
        raise Malformed("malformed", "not a batch [id, bytes, ...]")
    said: list[tuple[str, bytes]] = []
    for k in range(0, len(row), 2):
        robot, payload = row[k], row[k + 1]
        if type(robot) is not int or type(payload) is not bytes:
            raise Malformed("malformed", "not a batch [id, bytes, ...]")
        key = keys.get(robot)
        if key is not None:
            said.append((key, payload))
    return said
