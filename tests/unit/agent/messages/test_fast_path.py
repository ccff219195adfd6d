"""The fast paths: those that are written for the compiler are those that are made at run time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.messages import fast_path
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import CLASSES, Faults, HandState, Message, Mission
from handfast.agent.messages.validation import examined
from tests.declared_messages import messages_of
from tests.wire import opened

LONG = (Faults, Mission)
"""Their bounds are no comparisons of one number."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The module that `make compiled` makes C of, as Python."""
    path: Path = tmp_path_factory.mktemp("written") / "compiled_fast_path.py"
    path.write_text(fast_path.module(), encoding="utf-8")
    names: dict[str, Any] = {}
    exec(compile(path.read_text(encoding="utf-8"), path, "exec"), names)
    return names["TAKERS"]


def never(*_: object) -> NoReturn:
    raise AssertionError("the long way")


def array_of(message: Message) -> tuple[Any, ...]:
    array: tuple[Any, ...] = msgpack.unpackb(opened(encode(message)), use_list=False)
    return array


@pytest.mark.parametrize("number", range(len(CLASSES)), ids=lambda number: CLASSES[number].__name__)
@given(data=st.data())
@settings(max_examples=30)
def test_the_written_module_takes_what_is_taken_at_run_time(number: int, written: Any, data: st.DataObject):
    cls = CLASSES[number]
    message = data.draw(messages_of(cls))
    array = array_of(message)
    for take in (written[number], fast_path.taker(cls)):
        taken = take(array, examined if cls in LONG else never)
        assert taken == message
        assert type(taken) is cls


def test_what_needs_a_second_look_goes_the_long_way(written: Any):
    array = array_of(HandState.placed(1, 0, 0, True, 0, (0.0, 0.0, 0.0, 0.0)))
    for wrong in (array[:-1], (*array[:2], "1", *array[3:]), (*array[:2], -1, *array[3:])):
        for take in (written[0], fast_path.taker(HandState)):
            assert take(wrong, lambda cls, values: (cls, values)) == (HandState, wrong[2:])
