"""What is let in as an order, and what goes out as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode, head
from handfast.agent.messages.types import MISSION_BYTES_MAX, Ask, Faults, Heartbeat, Mission, Resume, Stop
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import AGE_NS_MAX, SEALS_BYTES_MAX, Opener, OrderGate, Sealer
from tests.trusted import FLEET, NOW_S, ROBOTS, authority, credentials

TIME_NS = NOW_NS = int(NOW_S * 1e9)
ORDERS = {
    key_expressions.mission(FLEET): Mission(
        1,
        TIME_NS,
        TIME_NS,
        9,
        "d",
        trajectory=(("kind", "hold"), ("start_m", (0.0, 1.5))),
        robots=((1, 0.0, 2.5),),
        removed=((6, TIME_NS),),
    ),
    key_expressions.stop(FLEET): Stop(2, TIME_NS, "why"),
    key_expressions.resume(FLEET): Resume(3, TIME_NS, (1, 2)),
    key_expressions.faults(FLEET): Faults(1, TIME_NS, "ann", 0, 0, ""),
    key_expressions.heartbeat(FLEET): Heartbeat(TIME_NS, "ann"),
    key_expressions.ask(FLEET): Ask(TIME_NS, "ann"),
}


class Scene:
    """An operator's gate and two robots'."""

    def __init__(self, folder: Path) -> None:
        with authority(folder / "authority") as by:
            ann = credentials(by, folder / "ann", of_operator(FLEET, "ann"))
        self.refused: list[str] = []
        self.operator, self.one, self.two = (
            OrderGate(FLEET, ROBOTS, Opener(FLEET, ["ann"], ann.authority), sealer, self.refused.append)
            for sealer in (Sealer(ann), None, None)
        )


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


@pytest.mark.parametrize("key", ORDERS)
def test_an_order_from_an_operator_through_a_robot_to_another(scene: Scene, key: str) -> None:
    payload = encode(ORDERS[key])
    sealed = scene.operator.let_out(key, payload, NOW_NS)
    assert sealed is not None
    assert sealed != payload
    assert scene.one.let_in(key, sealed, NOW_NS) == payload
    if key in (key_expressions.faults(FLEET), key_expressions.heartbeat(FLEET), key_expressions.ask(FLEET)):
        return  # these come from operators alone
    # The robot has the message, not the bytes: what it makes of it finds its seal again.
    told = scene.one.let_out(key_expressions.relayed(FLEET, 1), encode(decode(payload)), NOW_NS)
    assert told == sealed
    assert scene.two.let_in(key_expressions.relayed(FLEET, 1), told, NOW_NS) == payload
    assert scene.refused == []


def test_what_is_no_order_goes_through(scene: Scene) -> None:
    for key in (
        key_expressions.hand(FLEET, 1),
        key_expressions.status(FLEET, 1),
        key_expressions.events(FLEET),
        key_expressions.faults_held(FLEET, 1, "agent"),
    ):
        assert scene.one.let_out(key, b"x", NOW_NS) == b"x"
        assert scene.two.let_in(key, b"x", NOW_NS) == b"x"


def test_a_robot_gives_no_orders(scene: Scene) -> None:
    payload = encode(ORDERS[key_expressions.stop(FLEET)])
    for key in (*ORDERS, key_expressions.relayed(FLEET, 1)):
        assert scene.one.let_out(key, payload, NOW_NS) is None
        assert scene.two.let_in(key, payload, NOW_NS) is None
    scene.refused = [each for each in scene.refused if not each.startswith("to say")]
    assert scene.refused[0] == f"an order on {key_expressions.mission(FLEET)}: malformed"
    assert scene.refused[-1] == f"an order on {key_expressions.relayed(FLEET, 1)}: malformed"


def test_an_order_that_was_changed_on_its_way(scene: Scene) -> None:
    sealed = scene.operator.let_out(
        key_expressions.stop(FLEET), encode(ORDERS[key_expressions.stop(FLEET)]), NOW_NS
    )
    assert sealed is not None
    changed = sealed.replace(b"why", b"who")
    assert scene.one.let_in(key_expressions.relayed(FLEET, 2), changed, NOW_NS) is None
    assert scene.refused == [f"an order on {key_expressions.relayed(FLEET, 2)}: bad signature"]
    assert (
        scene.one.let_out(
            key_expressions.relayed(FLEET, 1), encode(ORDERS[key_expressions.stop(FLEET)]), NOW_NS
        )
        is None
    )
    assert scene.refused[1:] == [
        f"to say an order on {key_expressions.relayed(FLEET, 1)}: the operator's seal of it is no longer "
        f"known here"
    ]


def test_what_is_said_again_is_the_same(scene: Scene) -> None:
    payload = encode(ORDERS[key_expressions.mission(FLEET)])
    first = scene.operator.let_out(key_expressions.mission(FLEET), payload, NOW_NS)
    assert scene.operator.let_out(key_expressions.mission(FLEET), payload, NOW_NS) == first


def test_heartbeats_do_not_displace_what_is_said_again(scene: Scene) -> None:
    stop = encode(ORDERS[key_expressions.stop(FLEET)])
    pass_on(scene, key_expressions.stop(FLEET), stop)
    for number in range(200):
        pass_on(scene, key_expressions.heartbeat(FLEET), encode(Heartbeat(TIME_NS + number, "ann")))
    assert scene.one.let_out(key_expressions.relayed(FLEET, 1), stop, NOW_NS) is not None
    assert len(scene.one._sealed) == len(scene.operator._sealed) == 1


def test_what_is_remembered_is_bounded(scene: Scene) -> None:
    begin = head(Mission)
    large = [begin + bytes([number]) * (MISSION_BYTES_MAX - len(begin)) for number in range(30)]
    for payload in large:
        pass_on(scene, key_expressions.mission(FLEET), payload)
    for gate in (scene.one, scene.operator):
        kept = sum(len(payload) + len(sealed) for payload, sealed in gate._sealed.items())
        assert SEALS_BYTES_MAX // 2 < kept == gate._size <= SEALS_BYTES_MAX
    told = key_expressions.relayed(FLEET, 1)
    assert scene.one.let_out(told, large[-1], NOW_NS) is not None
    assert scene.one.let_out(told, large[0], NOW_NS) is None


def pass_on(scene: Scene, key: str, payload: bytes) -> None:
    """The operator gives an order and robot 1 takes it."""
    sealed = scene.operator.let_out(key, payload, NOW_NS)
    assert sealed is not None
    assert scene.one.let_in(key, sealed, NOW_NS) == payload


@pytest.mark.parametrize("key", ORDERS)
def test_what_was_overheard_long_ago_only_counts_where_versions_tell_its_age(scene: Scene, key: str) -> None:
    payload = encode(ORDERS[key])
    sealed = scene.operator.let_out(key, payload, NOW_NS)
    assert sealed is not None
    lasting = key in (
        key_expressions.mission(FLEET),
        key_expressions.stop(FLEET),
        key_expressions.resume(FLEET),
    )
    for off_ns in (AGE_NS_MAX + 1, -AGE_NS_MAX - 1):
        taken = scene.one.let_in(key, sealed, NOW_NS + off_ns)
        assert taken == (payload if lasting else None)
    assert scene.one.let_in(key, sealed, NOW_NS + AGE_NS_MAX) == payload
    if not lasting:
        assert scene.refused == [
            f"an order on {key}: sealed long ago (by this computer's clock)",
            f"an order on {key}: sealed in the future (by this computer's clock)",
        ]


@pytest.mark.parametrize(
    "key", [key_expressions.faults(FLEET), key_expressions.heartbeat(FLEET), key_expressions.ask(FLEET)]
)
def test_robots_tell_missions_stops_and_leaves_alone(scene: Scene, key: str) -> None:
    """What was overheard of the others must not push out of memory what has to be said again."""
    stop = encode(ORDERS[key_expressions.stop(FLEET)])
    pass_on(scene, key_expressions.stop(FLEET), stop)
    sealed = scene.operator.let_out(key, encode(ORDERS[key]), NOW_NS)
    assert sealed is not None
    told = key_expressions.relayed(FLEET, 2)
    assert scene.one.let_in(told, sealed, NOW_NS) is None
    assert scene.refused == [f"an order on {told}: not one that robots relay"]
    assert list(scene.one._sealed) == [stop]


@pytest.mark.parametrize("where", ["2/more", "2/line\nbreak", "9", "*", "02"])
def test_only_robots_of_the_fleet_tell_each_on_one_key(scene: Scene, where: str) -> None:
    """Each would have a budget of its own, and the log line what somebody likes."""
    stop = key_expressions.stop(FLEET)
    sealed = scene.operator.let_out(stop, encode(ORDERS[stop]), NOW_NS)
    assert sealed is not None
    assert scene.one.let_in(key_expressions.relayed(FLEET, where), sealed, NOW_NS) is None
    assert scene.refused == ["an order where no robot of the fleet relays any"]


def test_what_is_said_once_is_sealed_anew_each_time(scene: Scene) -> None:
    """Or live faults, said again to a robot that came later, would be too old."""
    key = key_expressions.faults(FLEET)
    payload = encode(ORDERS[key])
    first = scene.operator.let_out(key, payload, NOW_NS)
    later = scene.operator.let_out(key, payload, NOW_NS + 10**10)
    assert later is not None
    assert first != later
    assert scene.one.let_in(key, later, NOW_NS + 10**10) == payload
