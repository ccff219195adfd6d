"""Rows of a track hold what the recording holds, in pieces and thinned."""

from __future__ import annotations

import numpy as np
import pytest

from handfast.deploy.playback import scene as module
from handfast.deploy.playback.scene import COLUMNS, Track
from tests.unit.deploy.playback.runs import FLEET, result_of

COUNT = len(FLEET.robots)


def rows(data: bytes, track: Track) -> np.ndarray:
    return np.frombuffer(data, "<f4").reshape(-1, track.width)


def robots(data: bytes, track: Track) -> np.ndarray:
    return rows(data, track)[:, : COUNT * len(COLUMNS)].reshape(-1, COUNT, len(COLUMNS))


def test_a_row_holds_where_robots_are_and_should_be() -> None:
    result = result_of()
    track = Track(result)
    found = robots(track.piece(0), track)
    assert track.pieces == 1
    assert len(found) == track.rows == len(result.analysis.grid)
    np.testing.assert_allclose(found[:, :, 0:2], result.analysis.hands, atol=1e-5)
    np.testing.assert_allclose(found[:, :, 4:6], result.analysis.desired, atol=1e-5)
    body = result.recording.robots[2].body
    k = 30
    assert found[k, 1, 2] == pytest.approx(np.interp(k / 20, body.t, body["heading"]), abs=1e-5)
    assert found[k, 1, 3] == pytest.approx(0.1)  # as the bodies say


def test_a_row_holds_ages_ticks_and_forces_as_they_were_said_last() -> None:
    result = result_of()
    found = robots((track := Track(result)).piece(0), track)
    assert found[25, 0, COLUMNS.index("age_ms")] == pytest.approx(3.0)  # robot 2 is 3 ms old, robot 3 one
    ticks = found[:, 0, COLUMNS.index("tick_us")]
    assert np.nanmin(ticks) == np.nanmax(ticks) == 90 + 3 + 1  # the longest of four
    hand = result.recording.robots[3].hand
    k = 17
    said = hand["navigation_x"][np.searchsorted(hand.t, k / 20, side="right") - 1]
    assert found[k, 2, COLUMNS.index("navigation_x")] == pytest.approx(said, abs=1e-6)


def test_each_edges_wanted_distance_comes_after_the_robots() -> None:
    result = result_of()
    track = Track(result)
    wanted = rows(track.piece(0), track)[:, COUNT * len(COLUMNS) :]
    np.testing.assert_allclose(wanted, result.analysis.wanted, atol=1e-6)


def test_pieces_one_after_the_other_are_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    result = result_of()
    whole = Track(result).piece(0)
    monkeypatch.setattr(module, "PIECE_BYTES", 1)
    track = Track(result)
    assert track.piece_rows == module.PIECE_ROWS
    assert track.pieces == -(-track.rows // track.piece_rows) > 1
    assert b"".join(track.piece(number) for number in range(track.pieces)) == whole
    for number in (-1, track.pieces):
        with pytest.raises(IndexError):
            track.piece(number)


def test_the_overview_has_the_first_and_the_last_row_whatever_its_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = result_of()
    whole = rows(Track(result).piece(0), track := Track(result))
    for least in (1, 7 * track.width * 4, 10**9):
        monkeypatch.setattr(module, "OVERVIEW_BYTES", least)
        thin = Track(result)
        found = rows(thin.overview(), thin)
        assert len(found) <= max(3, least // (track.width * 4) + 1)
        np.testing.assert_array_equal(found[0], whole[0])
        np.testing.assert_array_equal(found[-1], whole[-1])
        np.testing.assert_array_equal(found[1:-1], whole[thin.stride : -1 : thin.stride][: len(found) - 2])
