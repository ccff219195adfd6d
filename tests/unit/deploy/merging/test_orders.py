"""Which orders in recordings count: sealed ones, or where nothing is sealed those that most robots have."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Heartbeat, Mission, Resume, Stop
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import Opener, Sealer
from handfast.deploy.inventory.certificate_builder import CERTIFICATE_DAYS
from handfast.deploy.merging import orders
from handfast.deploy.merging.orders import Orders, orders_given
from tests.trusted import FLEET, NOW_S, authority, credentials

NOW_NS = int(NOW_S * NS_PER_S)
STOP, RESUME = Stop(3, NOW_NS, "lunch"), Resume(4, NOW_NS + 5, ())
MISSION = Mission(1, NOW_NS - 5, NOW_NS, NS_PER_S, "0123456789abcdef")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Opener, Sealer, Sealer]]:
    """Who opens; who seals; and who seals for another authority."""
    folder = tmp_path_factory.mktemp("keys")
    with authority(folder / "authority") as by, authority(folder / "other") as other:
        ann = credentials(by, folder / "ann", of_operator(FLEET, "ann"))
        eve = credentials(other, folder / "eve", of_operator(FLEET, "ann"))
        yield Opener(FLEET, ["ann"], ann.authority), Sealer(ann), Sealer(eve)


def of_most(*of_robots: list[bytes], voters: int | None = None) -> Orders:
    recorded = dict(enumerate(of_robots, 1))
    return orders_given(recorded, None, lambda _: len(recorded) if voters is None else voters)


def test_what_most_have_counts_once() -> None:
    both = [encode(MISSION), encode(STOP)]
    assert of_most(both, both, [*both, encode(RESUME)]) == Orders([MISSION, STOP], {3: 1})
    assert of_most(both, both, []) == Orders([MISSION, STOP], {})
    assert of_most(both) == Orders([MISSION, STOP], {})


def test_half_is_not_most() -> None:
    assert of_most([encode(STOP)], []) == Orders([], {1: 1})
    assert of_most([encode(STOP)], [encode(STOP)], [], []) == Orders([], {1: 1, 2: 1})
    assert of_most([encode(STOP)], [encode(STOP)], [], [], voters=3).given == [STOP]


def test_the_same_order_said_again_is_one_and_nobody_alone_says_when_it_was_given() -> None:
    later, lie = (encode(STOP._replace(time_ns=NOW_NS + by)) for by in (9, -(10**12)))
    assert of_most([encode(STOP), later], [later], [lie]).given == [STOP]
    assert of_most([lie], [later, encode(STOP)], [encode(STOP)]).given == [STOP]


def test_what_is_no_order_does_not_count() -> None:
    heartbeat = encode(Heartbeat(NOW_NS, "ann"))
    assert of_most([heartbeat], [heartbeat, b"", b"\xff" * 99]) == Orders([], {1: 1, 2: 3})


def test_a_seal_counts_though_one_robot_alone_has_it(keys: tuple[Opener, Sealer, Sealer]) -> None:
    opener, ann, _ = keys
    sealed = ann.seal(encode(STOP), NOW_NS)
    assert orders_given({1: [], 2: [sealed], 3: []}, opener, lambda _: 3) == Orders([STOP], {})


def test_without_a_seal_of_an_operator_nothing_counts(keys: tuple[Opener, Sealer, Sealer]) -> None:
    opener, ann, eve = keys
    forged = [encode(STOP), eve.seal(encode(STOP), NOW_NS), b"", ann.seal(b"x", NOW_NS)]
    forged.append(ann.seal(encode(STOP), NOW_NS).replace(b"lunch", b"hunch"))
    everybody = dict.fromkeys((1, 2, 3), forged)
    assert orders_given(everybody, opener, lambda _: 3) == Orders([], dict.fromkeys((1, 2, 3), 5))


def test_a_seal_counts_by_the_time_at_which_it_was_made(keys: tuple[Opener, Sealer, Sealer]) -> None:
    """Recordings outlive certificates."""
    opener, ann, _ = keys
    for day, counts in ((0, True), (CERTIFICATE_DAYS - 1, True), (CERTIFICATE_DAYS + 2, False), (-9, False)):
        sealed = ann.seal(encode(STOP), NOW_NS + day * 86_400 * NS_PER_S)
        assert bool(orders_given({1: [sealed]}, opener, lambda _: 1).given) == counts, day


def test_sealed_orders_count_without_an_authority_if_most_have_them(
    keys: tuple[Opener, Sealer, Sealer],
) -> None:
    _, ann, _ = keys
    sealed = [ann.seal(encode(STOP), NOW_NS)]
    assert of_most(sealed, sealed, []) == Orders([STOP], {})
    assert of_most(sealed, [], []) == Orders([], {1: 1})


def test_so_many_orders_of_one_robot_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orders, "DISTINCT_MAX", 10)
    flood = [encode(STOP._replace(version=version)) for version in range(100)]
    assert of_most([*flood, encode(MISSION)], [encode(MISSION)], [encode(MISSION)]) == Orders(
        [MISSION], {1: 100}
    )
