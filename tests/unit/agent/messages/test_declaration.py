"""A message is declared by its class alone: fields, rows, bounds, and what is refused as a declaration."""

from __future__ import annotations

from collections import namedtuple
from typing import Annotated, Any, NamedTuple

import pytest

from handfast.agent.messages.declaration import FLOAT_MAX, REQUIRED, About, declared
from handfast.agent.messages.fast_path import taker
from handfast.agent.messages.types import CLASSES, HandState, LinkTrace, Multiplier
from handfast.agent.messages.validation import Malformed, examined
from handfast.agent.recorder.message_json import reader, schema, to_json


class Wind(NamedTuple):
    """What a message that somebody adds looks like."""

    robot: Annotated[int, About("Number of the robot", least=1, most=9999)]
    speed: Annotated[float, About("Of the wind", "m/s", least=0.0)]
    side: Annotated[str, About("From where", choices=("port", "starboard"), before="port")] = "port"
    gusts: Annotated[tuple[Multiplier, ...], About("Rows", rows=2, before=())] = ()


def test_fields_are_in_the_order_of_the_wire_with_what_is_said_of_them():
    robot, speed, side, gusts = declared(Wind)
    assert [field.name for field in declared(Wind)] == list(Wind._fields)
    assert (robot.kind, robot.bounds) == (int, (1, 9999))
    assert (speed.kind, speed.bounds, speed.about.text) == (float, (0.0, FLOAT_MAX), "Of the wind, m/s")
    assert (speed.about.before, side.about.before) == (REQUIRED, "port")
    assert (gusts.kind, gusts.row, gusts.named) == (tuple, Multiplier, True)


def test_every_message_is_declared_down_to_its_rows():
    for cls in CLASSES:
        for field in declared(cls):
            assert field.about.doc
            columns = declared(field.row) if field.row is not None else ()
            assert all(column.about.doc for column in columns)
    assert not next(field for field in declared(HandState) if field.name == "multipliers").named
    assert next(field for field in declared(LinkTrace) if field.name == "entries").named


@pytest.mark.parametrize("hint", [int, Annotated[int, "no About"], Annotated[dict[str, int], About("x")]])
def test_a_field_that_does_not_say_what_it_is_is_refused(hint: Any):
    kind = namedtuple("kind", "field")
    kind.__annotations__["field"] = hint
    with pytest.raises(TypeError, match="field "):
        declared(kind)


def test_all_comes_from_the_declaration():
    """A new field is declared in its class, and set where its message is made: nowhere else."""
    cls: Any = Wind
    wind = Wind(3, 2.5, "starboard", (Multiplier(1, 0.5),))
    assert taker(cls)((6, 0, 3, 2.5, "starboard", ((1, 0.5),)), examined) == wind
    for values, reason in (
        ((0, 2.5, "port", ()), "range"),
        ((3, -1.0, "port", ()), "range"),
        ((3, 2.5, "aft", ()), "range"),
        ((3, 2.5, "port", ((1, 0.5),) * 3), "range"),
        ((3, 2.5, 4, ()), "malformed"),
        ((3, float("nan"), "port", ()), "not_finite"),
    ):
        with pytest.raises(Malformed) as caught:
            taker(cls)((6, 0, *values), examined)
        assert caught.value.reason == reason
    assert examined(cls, (3, 2, "port", ())) == Wind(3, 2.0)
    text = b'{"robot":3,"speed":2.5,"side":"starboard","gusts":[{"neighbour":1,"value":0.5}]}'
    wind_json: Any = wind
    assert to_json(wind_json) == text
    assert reader(cls)({"robot": 3, "speed": 2.5}) == Wind(3, 2.5)
    assert schema(cls)["properties"]["side"]["enum"] == ["port", "starboard"]
