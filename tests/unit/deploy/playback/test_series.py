"""Curves keep every extreme, however few points they have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handfast.deploy.playback import scene as module
from handfast.deploy.playback.scene import nearest, series
from tests.unit.deploy.playback.runs import FLEET, result_of
from tests.unit.deploy.synthetic_run import in_formation


def test_curves_are_those_of_the_analysis() -> None:
    result = result_of(paths=in_formation(FLEET, 0.3, calm_s=0.4))
    found = series(result)
    analysis = result.analysis
    assert found["t"] == pytest.approx(analysis.grid, abs=1e-3)
    assert found["nearest"] == pytest.approx(nearest(analysis), abs=1e-4)
    assert min(found["nearest"]) == pytest.approx(analysis.closest.distance_m, abs=1e-3)
    errors = np.abs(analysis.distances - analysis.wanted).max(axis=1)
    assert found["error"] == pytest.approx(errors, abs=1e-4)
    assert len(found["edges"]) == len(analysis.edges)
    assert found["edges"][0]["low"] == found["edges"][0]["high"]
    assert max(value for value in found["tick"] if value is not None) == 90 + 3 + 3


def test_an_extreme_survives_thinning(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = in_formation(FLEET)
    calm = paths[0]
    # For one instant robot 1 is beside the others' way.
    paths[0] = lambda t: (calm(t)[0] - 5.0, *calm(t)[1:]) if abs(t - 1.35) < 0.01 else calm(t)
    whole = series(result := result_of(paths=paths))
    monkeypatch.setattr(module, "BINS", 5)
    thin = series(result)
    assert len(thin["t"]) <= 5
    for name, worst in (("error", max), ("tracking", max), ("nearest", min)):
        assert worst(thin[name]) == worst(whole[name])
    assert max(thin["edges"][0]["high"]) == max(whole["edges"][0]["high"])


def test_without_two_robots_known_there_is_no_nearest_pair() -> None:
    result = result_of()
    analysis = result.analysis
    analysis.hands[3, 1:] = np.nan
    assert np.isnan(nearest(analysis)[3])
    assert series(result)["nearest"][3] is None


def test_an_edge_that_is_no_more_has_no_curve() -> None:
    result = result_of()
    wanted = result.analysis.wanted.copy()
    wanted[20:, 1] = np.nan
    vars(result)["analysis"] = replace(result.analysis, wanted=wanted)
    found = series(result)["edges"][1]
    assert None not in found["low"][:20]
    assert set(found["low"][20:]) == set(found["high"][20:]) == {None}
