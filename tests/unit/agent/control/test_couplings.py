"""One class per coupling: what it makes of one robot's own constraints."""

from __future__ import annotations

from typing import get_args

import pytest

from handfast.agent.control import law
from handfast.agent.control.couplings import COUPLINGS, Constraint
from handfast.agent.control.peers.peers import Peers
from handfast.agent.control.peers.prediction import Prediction
from handfast.agent.fleet import sections
from handfast.agent.formation.reference import Instant
from handfast.agent.messages.types import HandState
from handfast.deploy.analysis import couplings

GAINS = law.Gains(1.8, 5.0, 1.0, 0.2)
S = 1_000_000_000
T0 = 1000 * S
REST = Prediction((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


def constraint(robot: int, apart_m: float, *, one_sided: bool = False, other: bool = True) -> Constraint:
    """To a robot on the x axis at rest, wanted 1 m away."""
    edge = law.edge((apart_m, 0.0), (0.0, 0.0), (0.0, 0.0), 1.0, 0.2, GAINS)
    key = -robot if one_sided else robot
    return Constraint(key, edge, REST if other else None, 1, one_sided)


def peers() -> Peers:
    return Peers(1, 0.4, 0.6, S // 50, lambda _time: Instant((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), {}))


def test_every_coupling_of_the_fleet_file_has_its_classes():
    names = set(get_args(sections.Coupling))
    assert set(COUPLINGS) == set(couplings.COUPLINGS) == names
    assert names >= {str(preset["control"]["coupling"]) for preset in sections.LAWS.values()}


def test_each_finds_its_own_multipliers():
    near, wall = constraint(2, 0.8), constraint(3, 0.7, one_sided=True, other=False)
    found = {}
    for name, kind in COUPLINGS.items():
        coupling = kind(GAINS, peers())
        found[name] = coupling.force([near, wall])
        assert coupling.shared()[0][0] == 2
    alone = law.multiplier_edge(near.edge), law.multiplier_edge(wall.edge, 1)
    assert found["edge"][0] == law.force(near.edge, alone[0])[0] + law.force(wall.edge, alone[1])[0]
    field = law.multiplier_penalty(near.edge, GAINS), law.multiplier_penalty(wall.edge, GAINS)
    assert found["penalty"][0] == law.force(near.edge, field[0])[0] + law.force(wall.edge, field[1])[0]
    first = law.multiplier_sweep(near.edge, 0.0, (0.0, 0.0), 3)
    second = law.multiplier_sweep(wall.edge, 0.0, (0.0, 0.0), 2)
    assert found["joint"][0] == law.force(near.edge, first)[0] + law.force(wall.edge, second)[0]


@pytest.mark.parametrize("name", sorted(COUPLINGS))
def test_a_one_sided_constraint_never_pulls(name: str):
    assert COUPLINGS[name](GAINS, peers()).force([constraint(2, 3.0, one_sided=True)]) == (0.0, 0.0)


def test_the_joint_law_meets_the_others_copy_half_way_and_forgets_at_a_restart():
    heard = peers()
    joint = COUPLINGS["joint"](GAINS, heard)
    near = constraint(2, 0.8)
    joint.force([near])
    ((_, own),) = joint.shared()
    state = HandState(2, 0, T0, True, 1, 0.0, 0.0, *[0.0] * 9, ((1, own + 1.0),), ())
    assert heard.accept(state, T0 + S) is None
    joint.force([near])
    pull = (law.force(near.edge, own + 0.5)[0], 0.0)
    ((_, met),) = joint.shared()
    assert met == pytest.approx(law.multiplier_sweep(near.edge, own + 0.5, pull, 2), rel=1e-12)
    joint.restart()
    assert joint.shared() == ()
