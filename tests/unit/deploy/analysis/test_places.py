"""How far robots are from their places, and when that is too far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handfast.agent.formation.geometry import resolve
from handfast.deploy.analysis.analysis import Analysis, analyse
from handfast.deploy.analysis.places import allowed_m, distances_m, last_there_s, together
from tests.unit.deploy.judged_run import PAIR, body, recorded
from tests.unit.deploy.synthetic_run import Path, make_fleet, messages, standing


def analysed(*hands: Path, spacing_m: float = 1.0) -> Analysis:
    fleet = make_fleet([(k * spacing_m, 0.0) for k in range(len(hands))], [])
    bodies = [body(hand, robot.hand_offset_m) for hand, robot in zip(hands, fleet.robots, strict=True)]
    return analyse(recorded(fleet, messages(fleet, bodies)), resolve(fleet))


@pytest.mark.parametrize("spacing_m", [0.5, 1.0, 8.0])
def test_what_is_allowed_goes_by_the_scale_of_the_formation(spacing_m: float) -> None:
    a = analysed(standing(0, 0), standing(spacing_m, 0), standing(2 * spacing_m, 0), spacing_m=spacing_m)
    assert allowed_m(a) == pytest.approx(0.25 * spacing_m)


def test_of_one_that_is_alone_the_safe_distance_is_allowed() -> None:
    assert allowed_m(analysed(standing(0, 0))) == pytest.approx(0.22)


def test_who_could_not_follow_has_no_distance() -> None:
    a = analysed(standing(0, 0.1), standing(1, 0))
    assert distances_m(a)[-1] == pytest.approx([0.1, 0.0])
    assert np.isnan(distances_m(replace(a, away=np.ones_like(a.away)))).all()


def test_a_formation_may_be_off_as_a_whole_by_half_the_way_to_another_place() -> None:
    for lag, turned, alike in ((0.45, 0.0, True), (0.55, 0.0, False), (0.2, 0.28, False)):
        a = analysed(standing(turned, lag), standing(1.0 - turned, lag))
        assert together(a).tolist() == [alike, alike], (lag, turned)
    assert together(analysed(standing(0, 0.2))).tolist() == [False], "alone it is no formation"


def test_when_all_were_there() -> None:
    def late(t: float) -> tuple[float, float, float]:
        return 1.0 if t > 1.0 else 1.3, 0.0, 0.0

    assert last_there_s(analysed(standing(0, 0), late)) == pytest.approx(1.0)
    assert last_there_s(analysed(standing(0, 0), standing(1.2, 0))) == 0.0
    assert last_there_s(analysed(standing(0, 0), standing(1.3, 0))) is None
    nobody = recorded(
        PAIR, [each for each in messages(PAIR, [standing(0, 0)] * 2) if "/plant" not in each[1]]
    )
    assert last_there_s(analyse(nobody, resolve(PAIR))) is None
