"""Reasons of many runs as few that are true."""

from __future__ import annotations

from handfast.deploy.sweep.kinds_of_reasons import LETTERED, kinds_of_reasons


def test_other_numbers_are_the_same_kind() -> None:
    assert kinds_of_reasons(["off by 0.5 m of 1 m", "late", "off by 0.25 m of 1 m"]) == [
        ("off by 0.25 to 0.5 m of 1 m", 2),
        ("late", 1),
    ]


def test_other_robots_are_no_numbers_of_a_span() -> None:
    """Once it read "Robot 1 to 2: without robots 1 and 2 (does not follow) until 0.0 to 0.6 s"."""
    said = [
        "Robots 1 and 2 were 0.9 m apart. Robot 1: without robot 2 (does not follow) until 0.0 s.",
        "Robots 1 and 3 were 0.8 m apart. Robot 1: without robot 3 (does not follow) until 0.6 s.",
        "Robots 2 and 3 were 0.7 m apart. Robot 3: without robot 2 (does not follow) until 0.1 s.",
    ]
    ((first, count), (second, alone)) = kinds_of_reasons(said)
    assert (first, count) == (
        "Robots A and B were 0.8 to 0.9 m apart. "
        "Robot A: without robot B (does not follow) until 0.0 to 0.6 s.",
        2,
    )
    assert (second, alone) == (said[2], 1), "who is without whom is not the same"
    assert LETTERED.search(first)
    assert not LETTERED.search(second)


def test_robots_that_are_the_same_in_all_runs_keep_their_names() -> None:
    said = [f"Robot 1: without robots 2, 3 and 4 until 0.{k} s; edge 1-2 is off" for k in range(3)]
    assert kinds_of_reasons(said) == [
        ("Robot 1: without robots 2, 3 and 4 until 0.0 to 0.2 s; edge 1-2 is off", 3)
    ]


def test_edges_and_large_lists() -> None:
    assert kinds_of_reasons(["edge 1-2 is off", "edge 2-5 is off"]) == [("edge A-B is off", 2)]
    said = ["9 robots (1-8, 12) are off", "12 robots (1-12) are off", "9 robots (2-10) are off"]
    assert kinds_of_reasons(said) == [("9 to 12 robots are off", 3)]
