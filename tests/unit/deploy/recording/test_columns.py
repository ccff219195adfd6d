"""Columns that grow with a run, in memory and in a file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handfast.deploy.recording.columns import ASIDE_BYTES, Store

MANY = ASIDE_BYTES // 8


def filled(store: Store) -> tuple[Any, Any, Any]:
    numbers, whole, records = store.column("d"), store.column("q"), store.records()
    for begin in (0, MANY, 2 * MANY):
        for k in range(begin, begin + MANY):
            numbers.append(0.5 * k)
            whole.append(2**60 + k)
            records.append((f"state {k % 7}", {"sent": k}))
        store.put_aside()
    numbers.extend((True, -1.5))
    return numbers, whole, records


@pytest.mark.parametrize("aside", [True, False])
def test_what_was_put_in_comes_out_in_order(tmp_path: Path, aside: bool) -> None:
    numbers, whole, records = filled(Store(tmp_path if aside else None))
    assert numbers.whole().tolist() == [*(0.5 * k for k in range(3 * MANY)), 1.0, -1.5]
    assert len(numbers) == 3 * MANY + 2
    assert whole.whole().dtype == np.int64
    assert whole.whole().tolist() == [2**60 + k for k in range(3 * MANY)]
    assert records.whole() == [(f"state {k % 7}", {"sent": k}) for k in range(3 * MANY)]
    numbers.append(7.0)
    assert numbers.whole()[-1] == 7.0
    copied = whole.whole()
    copied[0] = 0
    assert whole.whole()[0] == 2**60


def test_memory_is_given_back_and_the_file_leaves_nothing_behind(tmp_path: Path) -> None:
    store = Store(tmp_path)
    column = store.column("q")
    for _ in range(100):
        column.extend(range(10 * MANY))
        store.put_aside()
        assert len(column._new) == 0
    assert len(column) == 1000 * MANY
    assert os.listdir(tmp_path) == []


def test_a_few_numbers_stay_where_they_are(tmp_path: Path) -> None:
    store = Store(tmp_path)
    column = store.column("q")
    column.append(1)
    store.put_aside()
    assert len(column._new) == 1
    assert column.whole().tolist() == [1]


def test_where_nothing_can_be_written_nothing_is_lost(tmp_path: Path) -> None:
    numbers, *_ = filled(Store(tmp_path / "not there"))
    assert len(numbers.whole()) == 3 * MANY + 2


def test_a_disk_that_fills_up_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    column = store.column("q")
    column.extend(range(MANY))
    store.put_aside()
    column.extend(range(MANY, 2 * MANY))

    def full(_: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "write", full)
    store.put_aside()
    column.extend(range(2 * MANY, 3 * MANY))
    store.put_aside()
    assert column.whole().tolist() == list(range(3 * MANY))
