"""Who may be silent, by what is kept of when that may be, against a plain look at all of them."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.control.peers.lateness import UNSURE_NS
from handfast.agent.control.peers.peer import Peer
from handfast.agent.control.peers.peers import Peers
from handfast.agent.messages.types import Beacon, HandState, Silent
from tests.unit.agent.control.peers.neighbours import PERIOD, T0, S, peers

HORIZON_S = 0.6
STARTS = {2: (0.0, 0.0), 5: (1.0, 0.0), 9: (0.0, 1.0)}
ROBOTS = (2, 5, 11)  # the last is not in the fleet file
OPTIONS = {"starts": STARTS, "horizon_s": HORIZON_S, "beacon_ns": S // 5, "beacon_max_ns": S}

robots = st.sampled_from(ROBOTS)
ages = st.sampled_from((-PERIOD, 0, 1, PERIOD, S // 8, S // 4, S // 2))
hands = st.tuples(
    st.just("hand"), robots, ages, st.sampled_from((0, 200)), st.sampled_from((None, -600_000, 0, 900_000))
)
beacons = st.tuples(
    st.just("beacon"), robots, ages, st.sampled_from((0, 400, 900)), st.sampled_from(((), (1,), (1, 5), (9,)))
)
told = st.tuples(st.just("told"), robots, robots, ages)
others = st.one_of(
    st.tuples(st.just("presence"), robots, st.booleans()),
    st.tuples(st.just("listen"), st.frozensets(robots)),
    st.tuples(st.just("ignore"), robots),
    st.tuples(st.just("stood"), st.booleans()),
)
# Mostly it goes on as usual for a while: only then is somebody in time, and forgiven what is usual of it.
waits = st.tuples(st.just("wait"), st.sampled_from((PERIOD, PERIOD, S // 10, S // 4, S)))
seldom = st.tuples(st.just("seldom"), st.frozensets(robots))
usual = st.tuples(
    st.just("usual"), st.frozensets(robots), st.sampled_from((-S // 5, PERIOD, S // 10, S // 3))
)


def hand(known: Peers, now_ns: int, robot: int, age_ns: int, next_ms: int, echo_us: int | None) -> None:
    heard = () if echo_us is None else ((1, echo_us),)
    state = HandState.placed(robot, now_ns // PERIOD, now_ns - age_ns, True, 0, (0.0, 0.0, 0.0, 0.0))
    known.accept(state._replace(next_ms=next_ms, heard=heard), now_ns)


def beacon(
    known: Peers, now_ns: int, robot: int, age_ns: int, next_ms: int, unheard: tuple[int, ...], *rows: Silent
) -> None:
    place = 0.0, 0.0, 0.0, 0.0, 0.0
    said = Beacon(robot, 0, now_ns - age_ns, True, *place, 0, 0, -1, -1, rows, unheard, next_ms=next_ms)
    known.accept_beacon(said, now_ns)


def look(known: Peers, now_ns: int) -> tuple[list[int], tuple[int, ...]]:
    """The same by asking all of them: who may be silent, and who is given up."""

    def is_overdue(peer: Peer) -> bool:
        late = peer.direct_late_ns(now_ns) >= UNSURE_NS
        return late or peer.deaf or not peer.here or peer.message is None

    def is_given_up(peer: Peer) -> bool:
        since_ns = max(peer.direct_ns - peer.clock.used_ns, known._began_ns + known._rest_ns)
        return since_ns + peer.lateness.forgiven_ns < now_ns - round(HORIZON_S * S)

    found = [peer.robot for peer in known.known if is_overdue(peer)]
    return found, tuple(peer.robot for peer in known.known if is_given_up(peer))


@pytest.mark.slow
@settings(max_examples=400)
@given(st.lists(st.one_of(seldom, usual, hands, beacons, told, others, waits), max_size=30))
def test_those_are_found_whom_a_look_at_all_of_them_finds(events: list[tuple[object, ...]]):
    known, now_ns = peers(**OPTIONS), T0 + S
    for what, *with_what in events:
        match what, with_what:
            case "hand", [robot, age_ns, next_ms, echo_us]:
                hand(known, now_ns, robot, age_ns, next_ms, echo_us)
            case "beacon", [robot, age_ns, next_ms, unheard]:
                beacon(known, now_ns, robot, age_ns, next_ms, unheard)
            case "told", [robot, of, age_ns]:
                row = Silent(of, now_ns - age_ns, True, *[0.0] * 7)
                beacon(known, now_ns, robot, PERIOD, 0, (), row)
            case "usual", [those, age_ns]:
                for k in range(6):  # whose clock is ahead is found to be by what it echoes
                    now_ns += PERIOD
                    for robot in those:
                        hand(known, now_ns, robot, age_ns, 0, None if k < 5 else 20_000 - age_ns // 1000)
                    known.overdue(now_ns)
            case "seldom", [those]:  # of those most is forgiven, as was found when they might have been late
                for _ in range(3):
                    for robot in those:
                        beacon(known, now_ns, robot, PERIOD, 900, ())
                    known.overdue(now_ns)
                    now_ns += S // 3
            case "presence", [robot, here]:
                known.present(robot, here)
            case "listen", [those]:
                known.listen(those, now_ns)
            case "ignore", [robot]:
                known.ignore(robot)
            case "stood", [stood]:
                known.stood = stood
            case "wait", [ns]:
                now_ns += ns
        known.begin(now_ns)
        assert ([peer.robot for peer in known.overdue(now_ns)], known.given_up(now_ns)) == look(known, now_ns)


def test_whoever_is_in_time_is_not_asked_for() -> None:
    known = peers(**OPTIONS)
    for robot in STARTS:
        beacon(known, T0, robot, PERIOD, 900, ())
    assert known.overdue(T0) == []
    queue = known._overdue._queue
    before = list(queue)
    for tick in range(1, 5):
        for robot in STARTS:
            beacon(known, T0 + tick * PERIOD, robot, 0, 900, ())
        assert known.overdue(T0 + tick * PERIOD) == []
    assert queue == before  # what comes puts it off, which costs nothing until then


def test_one_that_is_listened_to_from_now_on_is_missed_sooner() -> None:
    known = peers(**OPTIONS)
    now_ns = T0
    for _ in range(3):
        for robot in STARTS:
            beacon(known, now_ns, robot, PERIOD, 900, ())
        now_ns += S // 3
        assert known.overdue(now_ns) == []
    known.listen({2}, now_ns)
    later_ns = now_ns + S // 2
    assert [peer.robot for peer in known.overdue(later_ns)] == look(known, later_ns)[0] == [2]
