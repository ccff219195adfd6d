"""Orders in a file of their own, and of a fleet file on its way to the processes."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomli_w

from handfast.agent.fleet.loading import load_fleet, parse_fleet, to_dict
from handfast.agent.fleet.model import FleetError
from tests.unit.deploy.orders.order_fleets import SQUARE, square

LEAVES = '[[order]]\nat = "5s"\nkind = "leave"\nrobot = 2\n'
JOINS = '[[order]]\nat = 2\nkind = "join"\nrobot = 7\nedges = [2, 3]\n'


def test_they_are_added_to_those_of_the_fleet_file(tmp_path: Path) -> None:
    (tmp_path / "square.toml").write_text(SQUARE + LEAVES)
    (tmp_path / "orders.toml").write_text(JOINS)
    fleet = load_fleet(tmp_path / "square.toml", orders=tmp_path / "orders.toml")
    assert [(order.kind, order.at) for order in fleet.orders] == [("leave", 5.0), ("join", 2.0)]
    assert load_fleet(tmp_path / "square.toml", orders=None).orders == fleet.orders[:1]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[order]]\nat = 1\nkind = "leave"\nrobot = 9\n', "order[1].robot: there is no robot 9"),
        (LEAVES + "by = 3\n", "order[1].by: is used by"),
        ("[control]\nkp = 2\n", "control: unknown table"),
        ("[[order]\n", "not valid TOML"),
    ],
)
def test_what_is_wrong_names_their_file(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "square.toml").write_text(SQUARE)
    (tmp_path / "orders.toml").write_text(text)
    with pytest.raises(FleetError) as caught:
        load_fleet(tmp_path / "square.toml", orders=tmp_path / "orders.toml")
    assert caught.value.source.endswith("orders.toml")
    assert says in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "square.toml").write_text(SQUARE)
    with pytest.raises(FleetError, match="cannot read the file of orders: no such file"):
        load_fleet(tmp_path / "square.toml", orders=tmp_path / "none.toml")


def test_a_fleet_with_orders_of_every_kind_is_written_as_it_was_read() -> None:
    orders = LEAVES + JOINS
    orders += '[[order]]\nat = 3\nkind = "replace"\nrobot = 3\nby = 8\nover_s = 2\n'
    orders += '[[order]]\nat = 4\nkind = "stop"\n'
    orders += '[[order]]\nat = 5\nkind = "resume"\nrobots = [1, 2]\n'
    for shape in (
        'trajectory = { kind = "circle", centre_m = [0, 0], radius_m = 2, speed_mps = 0.3 }',
        'trajectory = { kind = "hold" }',
        "formation = { distance_m = 1.5 }\nscale = 2",
    ):
        orders += f'[[order]]\nat = 6\nkind = "reshape"\n{shape}\n'
    fleet = square(text=SQUARE + orders)
    assert len(fleet.orders) == 8
    assert parse_fleet(tomli_w.dumps(to_dict(fleet)), source="again") == fleet
