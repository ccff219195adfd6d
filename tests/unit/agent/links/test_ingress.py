"""What a node takes off the bus: who may send what, links that fail, and what is said of live rules."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.agent.links.ingress import Ingress
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import Faults, HandState, LinkTrace, Stop
from handfast.agent.messages.validation import Malformed
from tests.unit.agent.links.test_fault_plan import CUT, NOW, PERIOD, fleet, live


def held(ingress: Ingress, now_ns: int) -> list[Faults]:
    messages = [(key, decode(payload)) for key, payload in ingress.outgoing(now_ns)]
    return [message for key, message in messages if type(message) is Faults and key == "two/robot/2/faults"]


def test_live_rules_are_echoed_while_they_hold_and_their_end_is_said() -> None:
    ingress = Ingress(fleet(), 2, "agent", {"hand": (1,)})
    assert held(ingress, NOW) == []
    message = live()
    assert ingress.accept(message, NOW) is None
    assert held(ingress, NOW) == [message]
    assert held(ingress, NOW + PERIOD) == []
    assert held(ingress, NOW + NS_PER_S) == [message]
    (end,) = held(ingress, NOW + 2 * NS_PER_S)
    assert (end.author, end.version, end.rules, end.time_ns) == ("ana", 1, "", NOW + 2 * NS_PER_S)
    assert held(ingress, NOW + 9 * NS_PER_S) == []


def test_refused_rules_are_not_echoed() -> None:
    ingress = Ingress(fleet(), 2, "agent", {"hand": (1,)})
    assert ingress.accept(live("nonsense"), NOW) == "scenario"
    assert held(ingress, NOW) == []


def hand(number: int, time_ns: int, robot: int = 1) -> bytes:
    return encode(HandState.placed(robot, number, time_ns, True, 0, (0.0, 0.0, 0.0, 0.0)))


class Taker:
    """Listens to the hand states of robot 1 over a link that may fail."""

    def __init__(self, faults: str = "") -> None:
        self.heard: list[int] = []
        self.damaged: list[str] = []
        self.reason: str | None = None
        self.ingress = Ingress(fleet(faults), 2, "agent", {"hand": (1,)}, self._damage)
        self.ingress.on("hand", HandState, self._accept, robot=1, topic="hand")

    def _accept(self, message: HandState, now_ns: int) -> str | None:
        self.heard.append(message.sequence)
        return self.reason

    def _damage(self, key: str, error: Malformed) -> None:
        self.damaged.append(f"{key}: {error.reason}")


def test_a_message_goes_to_who_takes_it_and_what_may_not_come_is_counted() -> None:
    taker = Taker()
    taker.ingress.receive(NOW, "hand", hand(7, NOW))
    assert (taker.heard, taker.ingress.rejected) == ([7], {})
    for key, payload in (
        ("hand", hand(8, NOW, robot=3)),  # of another robot
        ("elsewhere", hand(8, NOW)),
        ("hand", encode(Stop(1, NOW, ""))),  # of another class
    ):
        taker.ingress.receive(NOW, key, payload)
    assert (taker.heard, taker.ingress.rejected) == ([7], {"wrong_key": 3})
    taker.ingress.receive(NOW, "hand", b"rubbish")
    assert (taker.damaged, taker.ingress.rejected["checksum"]) == (["hand: checksum"], 1)
    taker.reason = "out_of_order"
    taker.ingress.receive(NOW, "hand", hand(6, NOW))
    assert taker.ingress.rejected["out_of_order"] == 1


def test_a_live_rule_takes_hold_of_messages_and_lets_go() -> None:
    taker = Taker()
    ingress = taker.ingress
    ingress.accept(live(CUT.replace('loss = "100%"', 'delay = "50ms"')), NOW)
    ingress.receive(NOW, "hand", hand(0, NOW))
    ingress.arrive(NOW + 49_000_000)
    assert taker.heard == []
    taker.reason = "duplicate"
    ingress.arrive(NOW + 50_000_000)
    assert (taker.heard, ingress.rejected) == ([0], {"duplicate": 1})
    after = NOW + 2 * NS_PER_S
    out = [decode(payload) for _, payload in ingress.outgoing(NOW)]
    out += [decode(payload) for _, payload in ingress.outgoing(after)]
    assert sum(type(message) is LinkTrace for message in out) == 1
    ingress.receive(after, "hand", hand(1, after))
    assert taker.heard == [0, 1]


def test_bytes_that_a_link_damaged_are_refused_when_they_arrive() -> None:
    taker = Taker('[faults]\ncorrupt = "100%"\n')
    taker.ingress.receive(NOW, "hand", hand(0, NOW))
    assert taker.damaged == []
    taker.ingress.arrive(NOW + PERIOD)
    assert (taker.heard, taker.damaged) == ([], ["hand: checksum"])


def test_a_change_is_echoed_at_once_and_a_renewal_is_not() -> None:
    ingress = Ingress(fleet(), 2, "agent", {"hand": (1,)})
    ingress.accept(live(), NOW)
    assert len(held(ingress, NOW)) == 1
    ingress.accept(live(time_ns=NOW + PERIOD), NOW + PERIOD)
    assert held(ingress, NOW + PERIOD) == []
    weaker = live(CUT.replace("100%", "20%"), version=2)
    ingress.accept(weaker, NOW + 2 * PERIOD)
    assert held(ingress, NOW + 2 * PERIOD) == [weaker]
    ingress.accept(live("", version=3), NOW + 3 * PERIOD)
    (end,) = held(ingress, NOW + 3 * PERIOD)
    assert (end.author, end.rules) == ("ana", "")


def test_a_message_from_the_future_does_not_keep_the_queue_from_others() -> None:
    taker = Taker('[faults]\nrate = "20kbit"\n')
    taker.ingress.receive(NOW, "hand", hand(0, NOW + 3600 * NS_PER_S))
    assert taker.heard == [0]  # at once: who takes it refuses it
    taker.ingress.receive(NOW, "hand", hand(1, NOW))
    assert taker.heard == [0]
    taker.ingress.arrive(NOW + NS_PER_S)
    assert taker.heard == [0, 1]
