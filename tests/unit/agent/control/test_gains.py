"""handfast.agent.control.gains: the softness of an edge, and that the law goes with the scale."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handfast.agent.control import law
from handfast.agent.control.gains import FOLD, SOFTNESS, gains_of, one_sided, softness
from handfast.agent.fleet.model import Fleet
from tests.unit.agent.fleet.fleet_texts import small


def bare(**control: float | None) -> Fleet:
    fleet = small()
    return replace(
        fleet,
        control=replace(fleet.control, **{"k2": None} | control),  # type: ignore[arg-type]
        avoidance=replace(fleet.avoidance, enabled=False),
    )


def test_a_k2_that_is_given_is_taken_as_it_is() -> None:
    gains = gains_of(bare(k2=7.0))
    assert [softness(gains, span) for span in (0.1, 1.0, 30.0)] == [7.0, 7.0, 7.0]
    assert one_sided(gains) == gains


def test_one_that_is_left_out_goes_with_the_span_of_the_edge() -> None:
    gains = gains_of(bare())
    assert [softness(gains, span) * span * span for span in (0.1, 1.0, 30.0)] == pytest.approx([SOFTNESS] * 3)


def test_where_the_pull_is_limited_edges_are_as_much_softer() -> None:
    """(N1) from c2 V / c1 = 2.25 m on: of FOLD spans that are further, the pull is so much less."""
    fleet = bare(c1=0.4, c2=0.6, max_speed_mps=1.5)
    gains = gains_of(replace(fleet, avoidance=replace(fleet.avoidance, enabled=True)))
    for span in (0.1, 1.6, 1.7, 8.0):
        less = min(1.0, 2.25 / (FOLD * span))
        assert softness(gains, span) == pytest.approx(SOFTNESS / span**2 / less)


def test_a_one_sided_constraint_is_as_soft_as_the_edge_that_it_is_half_of() -> None:
    gains = gains_of(small())
    for span in (0.3, 3.0, 30.0):
        assert softness(one_sided(gains), 0.5 * span) == pytest.approx(softness(gains, span))


COMPONENT = st.floats(-3.0, 3.0)
PAIR = st.tuples(COMPONENT, COMPONENT)


@given(PAIR, PAIR, PAIR, st.floats(0.4, 3.0), st.floats(0.01, 100.0))
def test_every_length_of_the_law_goes_with_the_edges_and_no_time_does(
    offset: tuple[float, float],
    velocity: tuple[float, float],
    navigation: tuple[float, float],
    distance: float,
    scale: float,
) -> None:
    gains = gains_of(bare())

    def force(size: float) -> tuple[float, float]:
        def sized(vector: tuple[float, float]) -> tuple[float, float]:
            return size * vector[0], size * vector[1]

        edge = law.edge(
            sized(offset), sized(velocity), sized(navigation), size * distance, size * 0.22, gains
        )
        return law.force(edge, law.multiplier_edge(edge))

    small_one, large_one = force(1.0), force(scale)
    if abs(offset[0]) + abs(offset[1]) > 1e-3:
        assert large_one == pytest.approx((scale * small_one[0], scale * small_one[1]), rel=1e-6, abs=1e-9)
