"""Hypothesis strategies for messages, made of their declarations: values up to every bound."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from handfast.agent.messages.declaration import Field, declared
from handfast.agent.messages.types import CHECK_TEXT_MIN, EVERY_AUTHOR, FLOAT_MAX, CheckLine, Faults, Message

ROWS_MAX = 64
NUMBER = st.integers(-(2**53), 2**53) | st.floats(-FLOAT_MAX, FLOAT_MAX)


def text(most: int) -> st.SearchStrategy[str]:
    return st.text(max_size=50).filter(lambda value: len(value.encode()) <= most)


def values(field: Field, most: int) -> st.SearchStrategy[Any]:
    """Values of a field; of a text at most so many bytes."""
    about = field.about
    if field.row is not None:
        texts = CHECK_TEXT_MIN if field.row is CheckLine else most
        row = st.tuples(*(values(column, texts) for column in declared(field.row)))
        made = row.map(field.row._make) if field.named else row  # type: ignore[attr-defined]
        return st.lists(made, max_size=min(ROWS_MAX, about.rows or 20)).map(tuple)
    if field.item is not None:
        return st.lists(values(field.item, most), max_size=about.rows or 60).map(tuple)
    if field.kind is object:
        return (
            text(most) | st.booleans() | NUMBER | st.lists(st.tuples(NUMBER, NUMBER), max_size=5).map(tuple)
        )
    if field.kind is str:
        if about.characters:
            printable = st.text(min_size=1, max_size=about.characters).filter(str.isprintable)
            return printable.filter(lambda author: author != EVERY_AUTHOR)
        return st.sampled_from(about.choices) if about.choices else text(most)
    if field.kind is bool:
        return st.booleans()
    least, greatest = field.bounds
    if field.kind is int:
        return st.integers(
            -(2**31) if least is None else int(least), 2**40 if greatest is None else int(greatest)
        )
    return st.floats(least, greatest)


def messages_of(cls: type[Message]) -> st.SearchStrategy[Any]:
    """Valid messages of one class, some of which are too long to be sent."""
    most = 2000 if cls is Faults else 200
    return st.builds(cls, **{field.name: values(field, most) for field in declared(cls)})
