"""Whatever a fleet file or override holds, the answer is a fleet or a FleetError; fleets survive writing."""

from __future__ import annotations

import datetime
import math
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.common.settings import Entry, entries
from handfast.agent.fleet.loading import digest, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError


def keys_in(model: type) -> set[str]:
    return {
        key
        for entry in entries(model).values()
        for inside in (entry.table or entry.tables,)
        for key in {entry.key} | (keys_in(inside) if inside is not None else set())
    }


KEYS = sorted(keys_in(Fleet))

scalars = (
    st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.integers(-3, 12)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["200ms", "20cm", "30%", "-90deg", "1e999s", "edge", "line", "circle", "waypoints"])
    | st.dates()
    | st.datetimes()
    | st.just(datetime.time(1, 2))
)
shown = st.characters(exclude_categories=["C", "Zl", "Zp"])
texts = st.text(shown)
keys = st.sampled_from(KEYS) | st.text(max_size=8)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4),
    max_leaves=8,
)


def answer(text: str, *overrides: str, law: str | None = None) -> Fleet | None:
    """The fleet, or None when it was refused as it should be: in lines that can be printed."""
    try:
        return parse_fleet(text, source="some", overrides=overrides, law=law)
    except FleetError as error:
        refused = error
    lines = str(refused).split("\n")
    assert refused.problems
    assert all(line.isprintable() for line in lines)
    assert len(lines) <= len(refused.problems) + 1
    return None


# --- fleets that are valid --------------------------------------------------------------------

far = st.floats(-50, 50)
points = st.tuples(far, far).map(list)
small = st.floats(0.01, 5)


@st.composite
def trajectories(draw: st.DrawFn) -> dict[str, Any]:
    kind = draw(st.sampled_from(["hold", "line", "circle", "waypoints"]))
    if kind == "line":
        return {"kind": kind, "velocity_mps": draw(points), "start_m": draw(points)}
    if kind == "circle":
        return {"kind": kind, "centre_m": draw(points), "radius_m": draw(small), "speed_mps": draw(small)}
    if kind == "waypoints":
        corners = draw(st.lists(points, min_size=2, max_size=5, unique_by=lambda point: (point[0], point[1])))
        return {"kind": kind, "waypoints_m": corners, "speed_mps": draw(small)}
    return {"start_m": draw(points)}


links = st.fixed_dictionaries(
    {},
    optional={
        "connection": st.from_regex(r"(udpin|tcp):[a-z0-9.]{1,20}:[1-9][0-9]{0,3}", fullmatch=True)
        | st.just("simulator"),
        "system": st.integers(1, 254),
        "arm": st.booleans(),
        "state_rate_hz": st.floats(5, 50),
        "signing_key": st.text(shown, min_size=1, max_size=20),
    },
)
DATUM = st.fixed_dictionaries(
    {"latitude_deg": st.floats(-85, 85), "longitude_deg": st.floats(-180, 180)},
    optional={"altitude_m": st.floats(-500, 9000)},
)


@st.composite
def fleets(draw: st.DrawFn) -> dict[str, Any]:
    ids = draw(st.lists(st.integers(1, 9999), min_size=1, max_size=6, unique=True))
    pairs = [[a, b] for k, a in enumerate(ids) for b in ids[:k]]
    edges = draw(st.lists(st.sampled_from(pairs), unique_by=tuple)) if pairs else []
    formation: dict[str, Any] = {
        "edges": edges,
        "safe_distance_m": 0.5,
        "distance_m": draw(
            st.floats(0.6, 9) | st.lists(st.floats(0.6, 9), min_size=len(edges), max_size=len(edges))
        ),
        "assign": draw(st.booleans()),
    }
    if draw(st.booleans()):
        formation["offsets"] = [[float(k), draw(far)] for k in range(len(ids))]
    rows = []
    for robot in ids:
        row = {"id": robot, "x_m": draw(far), "y_m": draw(far)}
        row |= draw(
            st.fixed_dictionaries(
                {}, optional={"mass_kg": small, "max_force_n": small, "heading_rad": far.map(math.sin)}
            )
        )
        if draw(st.booleans()):
            row["mavlink"] = draw(links)
        if draw(st.booleans()):
            row["plant"] = "mavlink"
            row["mavlink"] = {**row.get("mavlink", {}), "connection": f"udpout:10.0.0.1:{robot}"}
        rows.append(row)
    return {
        "datum": draw(DATUM),
        "fleet": {
            "name": draw(st.from_regex(r"[A-Za-z0-9_-]{1,40}", fullmatch=True)),
            "rate_hz": draw(st.floats(10, 1000)),
            "description": draw(texts),
        },
        "formation": formation,
        "control": draw(
            st.fixed_dictionaries(
                {}, optional={"kp": small, "coupling": st.sampled_from(["edge", "penalty"])}
            )
        ),
        "trajectory": draw(trajectories()),
        "robot_defaults": draw(
            st.fixed_dictionaries(
                {}, optional={"mass_kg": small, "position_noise_m": small, "mavlink": links}
            )
        ),
        "robot": rows,
    }


@pytest.mark.slow
@given(fleets())
def test_a_fleet_survives_being_written(table: dict[str, Any]) -> None:
    fleet = parse_fleet(tomli_w.dumps(table), source="drawn")
    again = parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again")
    assert again == fleet
    assert digest(again) == digest(fleet)


# --- and everything else ----------------------------------------------------------------------


@pytest.mark.slow
@given(fleets(), st.data())
def test_a_fleet_with_one_value_replaced(table: dict[str, Any], data: st.DataObject) -> None:
    section = data.draw(st.sampled_from(list(table)))
    target = data.draw(st.sampled_from(table["robot"])) if section == "robot" else table[section]
    target[data.draw(st.sampled_from(sorted(target)) | keys if target else keys)] = data.draw(values)
    fleet = answer(tomli_w.dumps(table))
    if fleet is not None:
        assert parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again") == fleet


@pytest.mark.slow
@given(st.dictionaries(keys, values, max_size=6))
def test_any_table(table: dict[str, Any]) -> None:
    assert answer(tomli_w.dumps(table)) is None or table


MINIMAL = """
fleet = { name = "m" }
formation = { edges = [[1, 2]], distance_m = 1, safe_distance_m = 0.2 }
robot = [{ id = 1, x_m = 0, y_m = 0 }, { id = 2, x_m = 1, y_m = 0 }]
"""


@given(
    st.lists(
        st.sampled_from(KEYS) | st.sampled_from(["1", "2", "", "x"]) | st.text(max_size=4),
        min_size=1,
        max_size=4,
    ),
    values.map(lambda value: tomli_w.dumps({"v": value})[4:]) | st.text(st.characters(), max_size=9),
)
def test_any_override(path: list[str], value: str) -> None:
    answer(MINIMAL, f"{'.'.join(path)}={value}")


@given(st.data())
def test_a_number_out_of_range_is_refused_wherever_it_stands(data: st.DataObject) -> None:
    bounded = [
        (section.key, field)
        for section in entries(Fleet).values()
        if section.table is not None and section.key not in ("formation", "trajectory")
        for field in entries(section.table).values()
        if field.hint in (int, float)
    ]
    section, field = data.draw(st.sampled_from(bounded))
    number = data.draw(st.floats(allow_nan=False, allow_infinity=False))
    assert _refused(section, field, number) or (field.setting.admits(number) and field.hint is float)


def _refused(section: str, field: Entry, number: float) -> bool:
    return answer(MINIMAL, f"{section}.{field.key}={number!r}") is None
