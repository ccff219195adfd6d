"""handfast.agent.common.reader: what a raw table reads as, and every message that it can give."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from handfast.agent.common.models import build, plain
from handfast.agent.common.reader import Reader
from handfast.agent.common.settings import Setting, about, setting


@dataclass(frozen=True, slots=True)
class Motor:
    lag_s: float = setting(0.1, "Lag.", unit="s", ge=0, lt=10)
    turns: int = setting(3, "Turns.", gt=0)


@dataclass(frozen=True, slots=True)
class Wheel(Motor):
    id: int = setting(0, "Number.", ge=1, required=True)
    spoked: bool = setting(False, "Spoked.")


@dataclass(frozen=True, slots=True)
class Frame:
    name: str = field(metadata=about("Name.", pattern="[a-z]+", pattern_says="small letters"))
    length_m: float = field(metadata=about("Length.", unit="m", gt=0, le=100, example="2.5"))
    colour: Literal["red", "green"] = setting("red", "Colour.")
    tilt_rad: float = setting(0.0, "Tilt.", unit="rad", ge=-math.pi, le=math.pi)
    share: float | None = setting(None, "Share.", unit="ratio", ge=0, le=1)
    spring: float = setting(1.0, "Spring.", unit="kg/s2")
    place: tuple[float, float] | None = setting(None, "Place.", unit="m", ge=-10, le=10)
    path: tuple[tuple[float, float], ...] | None = setting(None, "Path.", unit="m")
    gaps_m: float | tuple[float, ...] | None = setting(None, "Gaps.", unit="m", gt=0)
    pairs: tuple[tuple[int, int], ...] = setting((), "Pairs.")


@dataclass(frozen=True, slots=True)
class Cart:
    frame: Frame = field(metadata=about("The frame."))
    motor: Motor = field(metadata=about("The motor."))
    wheels: tuple[Wheel, ...] = field(
        metadata=about("Wheels.", key="wheel", shared=("wheel_defaults", Motor))
    )


FRAME = {"name": "cart", "length_m": 2}


def read(raw: dict[str, Any], *overrides: str) -> tuple[Cart | None, list[str]]:
    """The cart, or None, and the problems as lines."""
    reader = Reader(Cart)
    for override in overrides:
        reader.override(raw, override)
    values = reader.read(raw)
    problems = [str(problem) for problem in reader.problems]
    return (None if problems else build(Cart, values)), problems


def frame(**fields: object) -> tuple[Frame | None, list[str]]:
    """The frame with these fields, and the problems as lines."""
    cart, problems = read({"frame": {**FRAME, **fields}, "wheel": [{"id": 1}]})
    return (None if cart is None else cart.frame), problems


def test_a_full_document() -> None:
    cart, problems = read(
        {
            "frame": {
                **FRAME,
                "colour": "green",
                "place": [1, "20cm"],
                "path": [[0, 0], [1.5, 2]],
                "gaps_m": [1, 2.0],
                "pairs": [[1, 2]],
            },
            "motor": {"lag_s": "200ms"},
            "wheel_defaults": {"turns": 7},
            "wheel": [{"id": 1}, {"id": 2, "turns": 9, "spoked": True}],
        }
    )
    assert problems == []
    assert cart is not None
    assert cart.frame == Frame(
        "cart",
        2.0,
        colour="green",
        place=(1.0, 0.2),
        path=((0.0, 0.0), (1.5, 2.0)),
        gaps_m=(1.0, 2.0),
        pairs=((1, 2),),
    )
    assert cart.motor == Motor(lag_s=0.2)
    assert [(w.id, w.turns, w.lag_s, w.spoked) for w in cart.wheels] == [
        (1, 7, 0.1, False),
        (2, 9, 0.1, True),
    ]
    assert type(cart.frame.length_m) is float, "an int in the file is a float in the model"


def test_every_problem_at_once_and_the_good_rest() -> None:
    reader = Reader(Cart)
    values = reader.read(
        {
            "frame": {"name": "A", "length_m": -1, "pairs": [[1, 2], [3], [4, 5]], "tilt_rad": 1},
            "wheel": [{"id": 1}, {"turns": 0, "id": True}],
        }
    )
    assert [problem.place for problem in reader.problems] == [
        "frame.name",
        "frame.length_m",
        "frame.pairs[2]",
        "wheel[2].id",
        "wheel[2].turns",
    ]
    assert values["frame"]["tilt_rad"] == 1.0
    assert values["frame"]["pairs"] == ((1, 2), None, (4, 5))
    assert "length_m" not in values["frame"]
    assert values["wheels"][1] == {"spoked": False, "lag_s": 0.1}


@pytest.mark.parametrize(
    ("key", "raw", "message"),
    [
        ("length_m", True, 'must be a number (m), such as 2.5 or "20cm", got true'),
        ("length_m", [1], 'must be a number (m), such as 2.5 or "20cm", got [1]'),
        ("length_m", {"a": 1}, 'must be a number (m), such as 2.5 or "20cm", got {a = 1}'),
        ("length_m", math.nan, "must be a finite number, got nan"),
        ("length_m", -math.inf, "must be a finite number, got -inf"),
        ("length_m", 10**400, "must be a finite number, got an integer of 1329 bits"),
        ("length_m", 0, "must be more than 0 and at most 100 m, got 0"),
        ("length_m", 100.5, "must be more than 0 and at most 100 m, got 100.5"),
        ("length_m", "101m", 'must be more than 0 and at most 100 m, got "101m"'),
        (
            "length_m",
            "2 ft",
            'must be a number (m) or a string such as "20cm" (units: mm, cm, m, km), got "2 ft"',
        ),
        ("tilt_rad", 90, 'must be between -3.14159 and 3.14159 rad, got 90; degrees are written "90deg"'),
        ("share", 2, "must be between 0 and 1, got 2"),
        ("spring", "1.0", 'must be a number (kg/s2), such as 1.0, got "1.0"'),
        ("colour", "gren", 'must be one of "red", "green", got "gren"; did you mean "green"?'),
        ("colour", 1, 'must be one of "red", "green", got 1'),
        ("name", "A b", 'must be small letters, got "A b"'),
        ("name", 3, 'must be a string, such as "text", got 3'),
        ("place", [1], "must be an array of 2 numbers (m), got 1: [1]"),
        ("place", 1, "must be an array of 2 numbers (m), such as [1.0, 1.0], got 1"),
        ("gaps_m", True, "must be a number (m)"),
        ("pairs", [[1, 2]] * 2 + [7], "must be an array of 2 whole numbers, such as [1, 2], got 7"),
    ],
)
def test_messages_name_the_value_and_what_would_be_right(key: str, raw: object, message: str) -> None:
    got, problems = frame(**{key: raw})
    assert got is None
    assert len(problems) == 1
    place, said = problems[0].split(": ", 1)
    assert place.split("[")[0] == f"frame.{key}"
    if key != "gaps_m":
        assert said == message
    else:
        assert said.startswith("must be a number (m)")


@pytest.mark.parametrize(
    ("key", "raw", "place"),
    [("place", [0, 11], "frame.place[2]"), ("path", [[0, 0], [1, "x"]], "frame.path[2][2]")],
)
def test_an_element_is_named_by_its_position_from_one(key: str, raw: object, place: str) -> None:
    assert [problem.split(": ")[0] for problem in frame(**{key: raw})[1]] == [place]


@pytest.mark.parametrize(
    ("turns", "ok"), [(1, True), (2**70, True), (1.0, False), (True, False), ("1", False)]
)
def test_whole_numbers_are_integers_only(turns: object, ok: bool) -> None:
    cart, problems = read({"frame": FRAME, "motor": {"turns": turns}, "wheel": [{"id": 1}]})
    assert (cart is not None) == ok
    assert ok or problems[0].startswith("motor.turns: must be a whole number")


def test_bounds_are_open_or_closed_as_they_say() -> None:
    assert Setting("", gt=0).admits(1e-300)
    assert not Setting("", gt=0).admits(0)
    assert Setting("", ge=0).admits(0)
    assert not Setting("", lt=10).admits(10)
    assert Setting("", le=10).admits(10)


@pytest.mark.parametrize(
    ("raw", "problem"),
    [
        ({"wheel": [{"id": 1}]}, "frame: table [frame] is missing: it must give at least name and length_m"),
        (
            {"frame": 3, "wheel": [{"id": 1}]},
            "frame: must be a table: write [frame] and its fields below it, got 3",
        ),
        ({"frame": FRAME}, "wheel: there must be at least one [[wheel]]"),
        (
            {"frame": FRAME, "wheel": {"id": 1}},
            "wheel: must be an array of tables: write [[wheel]] above each entry, got {id = 1}",
        ),
        (
            {"frame": FRAME, "wheel": [{"id": 1}, 2]},
            "wheel[2]: must be a table, [[wheel]] with its fields below it, got 2",
        ),
        ({"frame": FRAME, "wheel": [{}]}, "wheel[1].id: is missing: write for example id = 1"),
        (
            {"frame": {"name": "a"}, "wheel": [{"id": 1}]},
            "frame.length_m: is missing: write for example length_m = 2.5",
        ),
        ({"frame": FRAME, "wheel": [{"id": 1}], "moter": {}}, "moter: unknown table; did you mean motor?"),
        (
            {"frame": {**FRAME, "lenght_m": 1}, "wheel": [{"id": 1}]},
            "frame.lenght_m: unknown field; did you mean length_m?",
        ),
        (
            {"frame": {**FRAME, "turns": 1}, "wheel": [{"id": 1}]},
            "frame.turns: unknown field; turns belongs in [motor] or [wheel_defaults] or [wheel]",
        ),
        (
            {"frame": FRAME, "wheel": [{"id": 1}], "motor": {"x y\n": 1}},
            'motor."x y\\n": unknown field; known here: lag_s, turns',
        ),
        (
            {"frame": FRAME, "wheel": [{"id": 1}], "wheel_defaults": {"turns": 0}},
            "wheel_defaults.turns: must be more than 0, got 0",
        ),
        ({"frame": FRAME, "wheel": [{"id": 1}], "wheel_defaults": {"id": 1}}, None),
    ],
)
def test_tables(raw: dict[str, Any], problem: str | None) -> None:
    cart, problems = read(raw)
    assert cart is None
    assert len(problems) == 1, "a shared default's problem is reported once, not for every entry"
    assert problem is None or problems == [problem]


@pytest.mark.parametrize(
    ("override", "get", "value"),
    [
        ("frame.length_m=3", lambda c: c.frame.length_m, 3.0),
        ("frame.length_m = 20cm ", lambda c: c.frame.length_m, 0.2),
        ("frame.colour=green", lambda c: c.frame.colour, "green"),
        ('frame.colour="green"', lambda c: c.frame.colour, "green"),
        ("frame.name=true", lambda c: c.frame.name, "true"),
        ("frame.pairs=[[1, 2]]", lambda c: c.frame.pairs, ((1, 2),)),
        ("motor.turns=5", lambda c: c.motor.turns, 5),
        ("motor={turns = 5}", lambda c: c.motor.turns, 5),
        ("wheel.7.turns=5", lambda c: [w.turns for w in c.wheels], [3, 5]),
        ("wheel_defaults.turns=5", lambda c: [w.turns for w in c.wheels], [5, 5]),
    ],
)
def test_overrides(override: str, get: Any, value: object) -> None:
    cart, problems = read({"frame": dict(FRAME), "wheel": [{"id": 4}, {"id": 7}]}, override)
    assert problems == []
    assert get(cart) == value


@dataclass(frozen=True, slots=True)
class Filter:
    order: Literal[1, 2] = setting(1, "Order.")
    steps: Literal["auto", "2", 4] = setting("auto", "Steps.")


@dataclass(frozen=True, slots=True)
class Sounder:
    filter: Filter = field(metadata=about("The filter."))


def of_filter(raw: dict[str, Any], *overrides: str) -> dict[str, Any] | str:
    """The fields of the filter, or the first problem."""
    reader = Reader(Sounder)
    for override in overrides:
        reader.override(raw, override)
    values = reader.read(raw)
    fields: dict[str, Any] = values.get("filter", {})
    return str(reader.problems[0]) if reader.problems else fields


@pytest.mark.parametrize(
    ("override", "fields"),
    [
        ("filter.order=2", {"order": 2, "steps": "auto"}),
        ("filter.steps=2", {"order": 1, "steps": "2"}),
        ("filter.steps=4", {"order": 1, "steps": 4}),
        ("filter.steps=auto", {"order": 1, "steps": "auto"}),
        ("filter.order=3", "--set filter.order: must be one of 1, 2, got 3"),
        ("filter.order=true", "--set filter.order: must be one of 1, 2, got true"),
        ('filter.order="2"', '--set filter.order: must be one of 1, 2, got "2"; did you mean 2?'),
    ],
)
def test_options_that_are_numbers(override: str, fields: dict[str, Any] | str) -> None:
    assert of_filter({"filter": {}}, override) == fields


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("motor.turms=5", "--set motor.turms: unknown field; did you mean turns?"),
        ("moto.turns=5", "--set moto.turns: unknown table; did you mean motor?"),
        ("motor.turns", "--set motor.turns: must be written as table.field=value, such as control.kp=1"),
        ("motor..turns=1", "--set motor..turns: must be written as table.field=value, such as control.kp=1"),
        (
            "motor.turns.x=1",
            "--set motor.turns.x: motor.turns is a single value: nothing can follow it but =value",
        ),
        ("wheel.7=1", "--set wheel.7: names an entry, not a field of it: write for example wheel.7.id=value"),
        ("wheel.5.turns=1", "--set wheel.5.turns: there is no wheel with id 5; ids are 4, 7"),
        ("wheel.x.turns=1", "--set wheel.x.turns: there is no wheel with id x; ids are 4, 7"),
        ("motor.turns=0", "--set motor.turns: must be more than 0, got 0"),
        ("wheel.7.turns=0", "--set wheel.7.turns: must be more than 0, got 0"),
        ("frame.pairs=[[1]]", "--set frame.pairs[1]: must be an array of 2 whole numbers, got 1: [1]"),
        ("motor={turms = 1}", "--set motor.turms: unknown field; did you mean turns?"),
        ("motor.turns=1\nx = 2", '--set motor.turns: must be a whole number, such as 3, got "1\\nx = 2"'),
        ("frame.name=\udcff", '--set frame.name: must be text in UTF-8, got "\\udcff"'),
        ("mo\x1btor.turns=1", None),
        ("motor.turns=" + "[" * 5000, None),
        ("motor.turns=" + "9" * 5000, None),
    ],
)
def test_override_problems_are_placed_on_the_command_line(override: str, problem: str | None) -> None:
    cart, problems = read({"frame": {"length_m": 1, "name": "a"}, "wheel": [{"id": 4}, {"id": 7}]}, override)
    assert cart is None
    assert len(problems) == 1
    assert problems[0].startswith("--set ")
    assert problems[0].isprintable()
    assert problem is None or problems == [problem]


@dataclass(frozen=True, slots=True)
class Radio:
    port: str | None = setting(None, "Port.", pattern="[a-z0-9]+", pattern_says="letters")
    rate: int = setting(9, "Rate.", ge=1)
    bands: tuple[int, ...] = setting((1, 2), "Bands.")


@dataclass(frozen=True, slots=True)
class Depot:
    length_m: float = field(metadata=about("Length.", unit="m"))
    width_m: float = setting(1.0, "Width.", unit="m")


@dataclass(frozen=True, slots=True)
class Truck:
    load_kg: float = setting(1.0, "Load.", unit="kg", ge=0)
    radio: Radio | None = field(default=None, metadata=about("Its radio."))
    home: Depot | None = field(default=None, metadata=about("Where it stays."))


@dataclass(frozen=True, slots=True)
class Named(Truck):
    id: int = setting(0, "Number.", ge=1, required=True)


@dataclass(frozen=True, slots=True)
class Convoy:
    trucks: tuple[Named, ...] = field(
        metadata=about("Trucks.", key="truck", shared=("truck_defaults", Truck))
    )
    depot: Depot | None = field(default=None, metadata=about("Where it starts."))


def convoy(raw: dict[str, Any], *overrides: str) -> tuple[Convoy | None, list[str]]:
    reader = Reader(Convoy)
    for override in overrides:
        reader.override(raw, override)
    values = reader.read(raw)
    problems = [str(problem) for problem in reader.problems]
    return (None if problems else build(Convoy, values)), problems


TWO: list[dict[str, Any]] = [{"id": 1}, {"id": 2}]


def test_a_table_that_may_be_left_out_is_none() -> None:
    made, problems = convoy({"truck": TWO})
    assert problems == []
    assert made == Convoy((Named(id=1), Named(id=2)))
    assert plain(made) == {"truck": [{"id": 1, "load_kg": 1.0}, {"id": 2, "load_kg": 1.0}]}


def test_a_table_that_may_be_left_out_is_complete_when_it_is_there() -> None:
    made, problems = convoy({"truck": [{"id": 1, "radio": {}}], "depot": {"length_m": 5}})
    assert problems == []
    assert made == Convoy((Named(id=1, radio=Radio()),), Depot(5.0))
    assert convoy(plain(made)) == (made, [])
    assert convoy({"truck": TWO, "depot": {}})[1] == [
        "depot.length_m: is missing: write for example length_m = 1.0"
    ]
    assert convoy({"truck": TWO}, "depot.width_m=2")[1] == [
        "depot.length_m: is missing: write for example length_m = 1.0"
    ]


def test_an_entrys_table_is_that_of_the_defaults_but_for_what_it_says_itself() -> None:
    raw = {
        "truck_defaults": {"radio": {"port": "a", "rate": 5, "bands": [3]}},
        "truck": [{"id": 1}, {"id": 2, "radio": {"rate": 7}}, {"id": 3, "radio": {"bands": []}}],
    }
    made, problems = convoy(raw)
    assert problems == []
    assert made is not None
    assert [truck.radio for truck in made.trucks] == [
        Radio("a", 5, (3,)), Radio("a", 7, (3,)), Radio("a", 5, ())
    ]  # fmt: skip
    assert convoy(plain(made)) == (made, [])


def test_one_entrys_table_is_not_anothers() -> None:
    raw = {"truck_defaults": {"radio": {"rate": 5}}, "truck": [{"id": 1}, {"id": 2}]}
    made, _ = convoy(raw, "truck.1.radio.port=x", "truck_defaults.radio.rate=6")
    assert made is not None
    assert [truck.radio for truck in made.trucks] == [Radio("x", 6), Radio(None, 6)]
    made, _ = convoy({"truck": [{"id": 1}, {"id": 2}]}, "truck.2.radio.port=x")
    assert made is not None
    assert [truck.radio for truck in made.trucks] == [None, Radio("x")]


@pytest.mark.parametrize(
    ("defaults", "row", "places"),
    [
        ({"radio": {"port": "A b"}}, {}, ["truck_defaults.radio.port"]),
        (
            {"radio": {"rate": 0}},
            {"radio": {"port": "B b"}},
            ["truck_defaults.radio.rate", "truck[1].radio.port"],
        ),
        ({"radio": {"prot": "a"}}, {}, ["truck_defaults.radio.prot"]),
        ({"radio": 3}, {}, ["truck_defaults.radio"]),
        ({"radio": [{"port": "a"}]}, {"radio": {"port": "a"}}, ["truck_defaults.radio"]),
        ({"radio": {"bands": [1, "x"]}}, {}, ["truck_defaults.radio.bands[2]"]),
        ({}, {"radio": "a"}, ["truck[1].radio"]),
        ({}, {"radio": {"bands": [1, 2.5]}}, ["truck[1].radio.bands[2]"]),
        (3, {}, ["truck_defaults"]),
    ],
)
def test_what_is_wrong_in_a_nested_table_is_told_once_and_where_it_is(
    defaults: Any, row: dict[str, Any], places: list[str]
) -> None:
    reader = Reader(Convoy)
    reader.read({"truck_defaults": defaults, "truck": [{"id": 1, **row}, {"id": 2}]})
    assert [problem.place for problem in reader.problems] == places


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        (
            "truck.2.radio=7",
            "--set truck.2.radio: must be a table: write [truck.radio] and its fields below it, got 7",
        ),
        ("truck.2.radio.port=A B", '--set truck.2.radio.port: must be letters, got "A B"'),
        ("truck.2.radio.ports=a", "--set truck.2.radio.ports: unknown field; did you mean port?"),
        (
            "truck.2.bands=a",
            "--set truck.2.bands: unknown field; bands belongs in [truck_defaults.radio] or [truck.radio]",
        ),
        (
            "truck.2.radio.rate.x=1",
            "--set truck.2.radio.rate.x: truck[2].radio.rate is a single value: nothing can follow it but "
            "=value",
        ),
        ("depot=1", "--set depot: must be a table: write [depot] and its fields below it, got 1"),
    ],
)
def test_overrides_in_nested_tables_that_are_wrong(override: str, problem: str) -> None:
    assert convoy({"truck": [{"id": 1}, {"id": 2}]}, override) == (None, [problem])
